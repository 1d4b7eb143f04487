//! Locations of campaigns; no campaign is mistaken for another.

use std::fs;
use std::path::Path;

use serde_json::Value;

use crate::common::campaign::Small;
use crate::common::{calmwalk, refuse, stderr, succeed};

/// Writes a campaign that ends quickly.
fn write(directory: &Path) {
    fs::create_dir_all(directory).unwrap();
    Small { steps: 30, max_per_walk: 1, seed_structures: &["fcc-100"], ..Small::default() }.write(directory);
}

fn status(here: &Path, of: &str) -> Value {
    serde_json::from_str(&succeed(here, ["status", of, "--json"])).unwrap()
}

/// Runs a campaign to its end. Returns its standard error.
fn run(here: &Path, arguments: &[&str]) -> String {
    let output = calmwalk(here, ["run", "--in-process"].iter().chain(arguments));
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    stderr(&output)
}

#[test]
fn campaigns_of_init_do_not_meet() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    for name in ["first", "second"] {
        let printed = succeed(here, ["init", name]);
        assert!(printed.contains(&format!("calmwalk status {name}\n")), "{printed}");
        // Both configurations are equal; only their paths differ.
        write(&here.join(name));
        let said = run(here, &[&format!("{name}/campaign.toml")]);
        assert!(said.contains(&format!("starting campaign '{name}' in {name}/campaign with /")), "{said}");
        assert!(here.join(name).join("campaign/campaign.sqlite").is_file());
        assert_eq!(status(here, name)["name"], name);
    }
    let said = run(here, &["first/campaign.toml"]);
    assert!(said.contains("campaign 'first' in first/campaign is finished: "), "{said}");
    let entries = fs::read_dir(here).unwrap().count();
    assert_eq!(entries, 2, "nothing was left in the working directory");

    // Every command accepts the directory that `init` created.
    for command in
        [&["status"][..], &["force-errors"], &["report", "--output", "page"], &["walks"], &["store", "check"]]
    {
        let arguments = command.iter().copied();
        let last = if command == ["walks"] { &["resume", "--all"][..] } else { &[] };
        let (words, options): (Vec<_>, Vec<_>) =
            arguments.partition(|word| !word.starts_with("--") && *word != "page");
        succeed(here, words.into_iter().chain(["second"]).chain(options).chain(last.iter().copied()));
    }
    assert!(
        succeed(here, ["estimate", "first/campaign.toml", "--cost-from", "second"]).contains("newest label")
    );
    succeed(here, ["label", "--store", "second", "--until-empty"]);
}

#[test]
fn a_directory_with_several_campaigns_is_not_enough() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write(here);
    fs::copy(here.join("campaign.toml"), here.join("other.toml")).unwrap();
    run(here, &["campaign.toml"]);
    // A campaign with a configuration is preferred to one without.
    succeed(here, ["store", "backup", "campaign", "copy"]);
    assert_eq!(status(here, ".")["name"], here.file_name().unwrap().to_str().unwrap());
    run(here, &["other.toml"]);
    let message = refuse(here, ["status", "."]);
    assert!(message.contains(". contains 2 campaigns: name one of ./campaign, ./other"), "{message}");
    assert_eq!(status(here, "other")["name"], "other");
}

#[test]
fn a_campaign_refuses_the_configuration_of_another() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    for name in ["first", "second"] {
        write(&here.join(name));
    }
    let both = |from: &str| ["run", from, "--directory", "shared"].map(str::to_owned);
    run(here, &["first/campaign.toml", "--directory", "shared"]);
    let database = fs::read(here.join("shared/campaign.sqlite")).unwrap();
    let message = refuse(here, both("second/campaign.toml"));
    let first = here.canonicalize().unwrap().join("first/campaign.toml");
    let expected = format!("is 'first', which belongs to another configuration, {}", first.display());
    for words in ["second/campaign.toml: ", &expected, "with --directory", "by --adopt"] {
        assert!(message.contains(words), "{words}: {message}");
    }
    // The error about a changed value also names the campaign, so that users do not edit the wrong file.
    let text = fs::read_to_string(here.join("second/campaign.toml")).unwrap();
    fs::write(here.join("second/campaign.toml"), text.replace("tau = 0.3", "tau = 0.4")).unwrap();
    let message = refuse(here, both("second/campaign.toml"));
    assert!(message.contains("walk.tau") && message.contains("is 'first', configured by "), "{message}");
    fs::write(here.join("second/campaign.toml"), text).unwrap();
    assert_eq!(fs::read(here.join("shared/campaign.sqlite")).unwrap(), database);

    let said = run(here, &["second/campaign.toml", "--directory", "shared", "--adopt"]);
    assert!(said.contains("second/campaign.toml replaces "), "{said}");
    run(here, &["second/campaign.toml", "--directory", "shared"]);
    assert!(refuse(here, both("first/campaign.toml")).contains("is 'second', which belongs to another"));
    let found = status(here, "shared");
    assert_eq!(
        (&found["name"], &found["configuration"]["began_with"]["path"]),
        (&"second".into(), &first.display().to_string().into())
    );
}

#[test]
fn a_campaign_moves_with_its_configuration() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write(&here.join("first"));
    run(here, &["first/campaign.toml"]);
    // Move both, then rename the configuration.
    fs::rename(here.join("first"), here.join("moved")).unwrap();
    let said = run(here, &["moved/campaign.toml"]);
    assert!(said.contains("campaign 'moved' in moved/campaign is finished"), "{said}");
    fs::rename(here.join("moved/campaign.toml"), here.join("moved/hot.toml")).unwrap();
    run(here, &["moved/hot.toml", "--directory", "moved/campaign"]);
    assert_eq!(status(here, "moved/campaign")["name"], "hot");
    // A backup belongs to the same configuration.
    succeed(here, ["store", "backup", "moved", "restored"]);
    run(here, &["moved/hot.toml", "--directory", "restored"]);
}

#[test]
fn a_campaign_in_the_working_directory_is_not_begun_anew() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write(&here.join("first"));
    // A campaign of an earlier version, which did not record configuration files.
    run(here, &["first/campaign.toml", "--directory", "campaign"]);
    forget_the_configuration(&here.join("campaign"));
    let message = refuse(here, ["run", "first/campaign.toml"]);
    for words in [
        "campaign already contains",
        "--directory campaign to continue",
        "--directory first/campaign to start",
    ] {
        assert!(message.contains(words), "{words}: {message}");
    }
    assert!(!here.join("first/campaign").exists());
    run(here, &["first/campaign.toml", "--directory", "campaign"]);
    // It now belongs to this configuration, and does not block others.
    write(&here.join("second"));
    run(here, &["second/campaign.toml"]);
    assert!(
        refuse(here, ["run", "first/campaign.toml"])
            .contains("campaign already contains a campaign of this configuration")
    );
    // The same for a campaign beside its configuration.
    run(here, &["second/campaign.toml", "--directory", "second"]);
    fs::remove_dir_all(here.join("second/campaign")).unwrap();
    assert!(refuse(here, ["run", "second/campaign.toml"]).contains("--directory ./second to continue"));
}

fn forget_the_configuration(campaign: &Path) {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let store = store::Store::open(campaign).await.unwrap();
        store.set_metadata("configuration_file", "").await.unwrap();
        store.close().await;
    });
}
