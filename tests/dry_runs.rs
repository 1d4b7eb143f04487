//! `--dry-run` shows what a command would change, and changes nothing: the database has the same bytes. `--json` and `--quiet` of
//! commands that scripts call.

use std::fs;
use std::path::Path;

use serde_json::Value;

use crate::common::campaign::Small;
use crate::common::{calmwalk, refuse, succeed};

fn json_of(here: &Path, arguments: &[&str]) -> Value {
    serde_json::from_str(&succeed(here, [arguments, &["--json"]].concat())).unwrap()
}

fn database(here: &Path) -> Vec<u8> {
    fs::read(here.join("campaign/campaign.sqlite")).unwrap()
}

#[test]
fn nothing_is_changed_without_saying_so() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small::default().write(here);
    succeed(here, ["run", "campaign.toml"]);
    let labelled = json_of(here, &["queue", "campaign", "list", "--state", "labelled"]);
    let [first, second] = [0, 1].map(|k| labelled[k]["candidate"].as_str().unwrap());
    succeed(here, ["exclude", "campaign", second, "--reason", "wrong k-points"]);
    let before = database(here);

    let said = succeed(here, ["exclude", "campaign", first, second, "--reason", "no", "--dry-run"]);
    assert!(
        said.contains(&format!("{first}: label of 'potential' would be excluded; nothing was changed")),
        "{said}"
    );
    assert!(
        said.contains(&format!("{second}: label of 'potential' was already excluded: wrong k-points")),
        "{said}"
    );
    let undone = json_of(here, &["exclude", "campaign", second, first, "--undo", "--dry-run"]);
    assert_eq!((&undone[0]["changed"], &undone[1]["changed"]), (&true.into(), &false.into()));
    let said = succeed(here, ["lower-states", "campaign", "--all", "--dry-run"]);
    assert!(said.contains("nothing was changed"), "{said}");
    assert!(refuse(here, ["lower-states", "campaign", "--dry-run"]).contains("needs IDs or --all"));
    let said = succeed(here, ["store", "compact", "campaign", "--drop-declined-features", "--dry-run"]);
    assert!(said.contains("MB now") && said.ends_with("nothing was changed\n"), "{said}");
    assert_eq!(json_of(here, &["store", "compact", "campaign", "--dry-run"])["dry_run"], true);
    succeed(here, ["relabel", "campaign", first, "--dry-run"]);
    assert_eq!(json_of(here, &["exclude", "campaign", "--list"]).as_array().unwrap().len(), 1);
    assert!(database(here) == before, "a dry run writes nothing");

    check_json(here);
    check_quiet(here);
    assert!(database(here) == before, "no reader writes");
    // The same commands without --dry-run do change it.
    succeed(here, ["exclude", "campaign", first, "--reason", "no"]);
    assert_eq!(json_of(here, &["exclude", "campaign", "--list"]).as_array().unwrap().len(), 2);
    let quiet = calmwalk(here, ["--quiet", "run", "campaign.toml"]);
    let text = String::from_utf8(quiet.stderr).unwrap();
    assert!(quiet.status.success() && !text.contains("calmwalk dashboard"), "no hints: {text}");
}

fn check_json(here: &Path) {
    let exported = json_of(here, &["export", "campaign", "--output", "set.extxyz"]);
    let frames = atoms::read_extxyz(&here.join("set.extxyz")).unwrap().len();
    assert_eq!(exported["files"][0]["structures"], frames);
    assert_eq!((&exported["files"][0]["path"], &exported["excluded"]), (&"set.extxyz".into(), &1.into()));
    assert_eq!(exported["without_label"]["failed"], 0);
    let report = json_of(here, &["report", "campaign", "--output", "pages"]);
    for file in report["files"].as_array().unwrap() {
        assert!(here.join("pages").join(file.as_str().unwrap()).is_file(), "{file}");
    }
    assert!(here.join(report["page"].as_str().unwrap()).is_file());
    let checked = json_of(here, &["store", "check", "campaign"]);
    assert!(
        checked["rows"].as_u64() > Some(10) && checked["problems"].as_array().unwrap().is_empty(),
        "{checked}"
    );
    let copied = json_of(here, &["store", "backup", "campaign", "copy"]);
    assert_eq!(copied["bytes"], fs::metadata(here.join("copy/campaign.sqlite")).unwrap().len());
}

/// Results are printed, progress and hints are not.
fn check_quiet(here: &Path) {
    for command in [&["status", "campaign"][..], &["export", "campaign", "--output", "again.extxyz"]] {
        let quiet = calmwalk(here, [&["--quiet"][..], command].concat());
        assert!(quiet.status.success() && quiet.stderr.is_empty(), "{command:?}: {quiet:?}");
        assert!(!quiet.stdout.is_empty(), "{command:?}");
    }
}
