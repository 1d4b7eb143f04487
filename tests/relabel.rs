//! `calmwalk relabel`: repeats doubtful labels, and changes the protocol of a campaign. `CALMWALK_POSTGRES` runs the same
//! tests on a server.

use std::fs;
use std::time::Duration;

use serde_json::Value;
use store::{CampaignLock, JobState};

use crate::common::campaign::Small;
use crate::common::label_campaign::LabelCampaign;
use crate::common::processes::signal;
use crate::common::{calmwalk, config, random, refuse, stderr, succeed};

/// A finished campaign, and its number of labels.
fn labelled() -> (LabelCampaign, u64) {
    let place = LabelCampaign::new(&Small { steps: 120, ..Small::default() }, &[]);
    assert_eq!(place.run().0.wait().unwrap().code(), Some(0), "{}", place.said());
    let labels = place.jobs("labelled");
    assert!(labels > 2, "{labels}");
    (place, labels)
}

/// Writes `fine.toml`: the same campaign with another label potential, under a protocol of this name.
fn another_protocol(place: &LabelCampaign, name: &str) {
    let potential = config("data/Al_mm.eam.fs");
    let text = fs::read_to_string(place.path().join("campaign.toml")).unwrap();
    let text = text.replace(&potential.display().to_string(), "fine.eam.fs");
    let text = text.replace("[label]", &format!("[label]\nprotocol = \"{name}\""));
    fs::write(place.path().join("fine.toml"), text).unwrap();
    let potential = format!("another comment {}", fs::read_to_string(potential).unwrap());
    fs::write(place.path().join("fine.eam.fs"), potential).unwrap();
}

fn relabel(place: &LabelCampaign, arguments: &[&str]) -> String {
    succeed(place.path(), [&["relabel", place.argument()], arguments].concat())
}

fn run(place: &LabelCampaign, configuration: &str) {
    let mut run = place.start(&["run", configuration, "--directory", "."]);
    assert_eq!(run.0.wait().unwrap().code(), Some(0), "{}", place.said());
}

/// Protocol and candidate of each structure in an export.
fn exported(place: &LabelCampaign) -> Vec<(String, String)> {
    let text = String::from_utf8(place.export()).unwrap();
    let value = |line: &str, key: &str| {
        let (_, rest) = line.split_once(&format!(" {key}=")).unwrap();
        rest.split_whitespace().next().unwrap().trim_matches('"').to_owned()
    };
    let comments = text.lines().filter(|line| line.contains("protocol_hash="));
    comments.map(|line| (value(line, "protocol"), value(line, "candidate_id"))).collect()
}

fn check(place: &LabelCampaign) {
    let found = succeed(place.path(), ["store", "check", place.argument()]);
    assert!(found.starts_with("no problems found"), "{found}");
}

#[test]
fn a_campaign_changes_to_another_protocol_label_by_label() {
    let (place, labels) = labelled();
    another_protocol(&place, "fine");
    let (here, campaign) = (place.path(), place.argument());
    let refused = refuse(here, ["run", "fine.toml", "--directory", "."]);
    assert!(
        refused.contains("labels of two protocols") && refused.contains("calmwalk relabel --config"),
        "{refused}"
    );

    let with = ["--config", "fine.toml", "--all", "--reason", "a finer grid"];
    let planned = relabel(&place, &[&with[..], &["--dry-run"]].concat());
    for words in [
        "label.protocol is now \"fine\" (was \"potential\")".to_owned(),
        "protocol 'fine' would become the current label protocol".to_owned(),
        format!(
            "{labels} structures would be queued again for protocol 'fine', to replace {labels} labels of 'potential'"
        ),
        format!("estimated from {labels} labels by 'potential'"),
        "nothing was changed".to_owned(),
    ] {
        assert!(planned.contains(&words), "{words} in {planned}");
    }
    assert_eq!((place.jobs("relabelling"), place.jobs("labelled")), (0, labels));

    let asked = relabel(&place, &with);
    assert!(asked.contains(&format!("{labels} structures are queued again")), "{asked}");
    assert!(
        asked.contains("next: compute the labels with calmwalk run fine.toml")
            && asked.contains("calmwalk label --store"),
        "{asked}"
    );
    let twice: Value = serde_json::from_str(&relabel(&place, &[&with[..], &["--json"]].concat())).unwrap();
    assert_eq!((&twice["relabelling"], &twice["waiting_already"]), (&0.into(), &labels.into()));
    assert_eq!((place.jobs("relabelling"), place.jobs("queued")), (labels, labels));
    let before = exported(&place);
    // Two candidates with the same structure share one label.
    assert!(before.len() as u64 >= labels && before.iter().all(|(protocol, _)| protocol == "potential"));
    check(&place);
    assert!(refuse(here, ["run", "campaign.toml", "--directory", "."]).contains("labels of two protocols"));

    run(&place, "fine.toml");
    let after = exported(&place);
    assert!(after.iter().all(|(protocol, _)| protocol == "fine"), "{after:?}");
    let names = |rows: &[(String, String)]| rows.iter().map(|row| row.1.clone()).collect::<Vec<_>>();
    assert_eq!(names(&after), names(&before));
    assert_eq!((place.jobs("labelled"), place.jobs("relabelling"), place.jobs("queued")), (labels, 0, 0));
    assert_eq!(place.jobs("superseded"), labels);
    assert!(succeed(here, ["status", campaign]).contains(&format!(", {labels} superseded")));
    succeed(here, ["report", campaign, "-o", "report"]);
    let summary = fs::read_to_string(here.join("report/tables/summary.csv")).unwrap();
    let words = format!("{labels} labelled, 0 failed, 0 dropped, {labels} superseded, 0 leased, 0 queued");
    assert!(summary.contains(&words), "{summary}");
    let details = succeed(here, ["explain", campaign, &after[0].1]);
    for words in ["superseded", "ago: a finer grid", "protocol 'fine'", "protocol 'potential'"] {
        assert!(details.contains(words), "{words} in {details}");
    }
    check(&place);
    let nothing = relabel(&place, &["--all"]);
    assert!(nothing.contains("0 structures are queued again"), "{nothing}");
    assert!(
        nothing.contains(&format!("{labels} structures skipped")) && !nothing.contains("next: "),
        "{nothing}"
    );
}

#[test]
fn a_protocol_needs_its_own_name_and_a_campaign_that_is_not_running() {
    let (place, _) = labelled();
    another_protocol(&place, "potential");
    let with = ["relabel", place.argument(), "--config", "fine.toml", "--all"];
    let refused = refuse(place.path(), with);
    assert!(refused.contains("choose a new name"), "{refused}");
    another_protocol(&place, "fine");
    let lock = CampaignLock::acquire(place.path(), "somebody");
    if place.argument() == "." {
        let output = calmwalk(place.path(), with);
        assert!(!output.status.success() && stderr(&output).contains("somebody"), "{}", stderr(&output));
    }
    drop(lock);
    assert_eq!(place.jobs("relabelling"), 0);
    check(&place);
}

#[test]
fn doubtful_labels_are_made_again_by_the_same_protocol() {
    let (place, labels) = labelled();
    let before = exported(&place);
    let (doubtful, bytes) = (&before[1].1, place.export());
    let all = relabel(&place, &["--where", "max_force >= 0"]);
    assert!(
        all.contains("0 structures are queued again") && all.contains("(use --include-current to relabel)"),
        "{all}"
    );
    assert!(
        refuse(place.path(), ["relabel", place.argument(), "--where", "max_force > 1e9"])
            .contains("no labelled structure")
    );
    relabel(&place, &[doubtful, "--reason", "a faulty node"]);
    let listed = succeed(place.path(), ["queue", place.argument(), "list", "--state", "queued"]);
    assert!(listed.contains(doubtful) && listed.contains("queued, relabelling"), "{listed}");
    let shown = succeed(place.path(), ["queue", place.argument(), "show", doubtful]);
    assert!(shown.contains("relabel   requested: a faulty node"), "{shown}");
    assert_eq!(place.export(), bytes, "the label stays");
    check(&place);
    assert_eq!(place.label(&["--until-empty"]).0.wait().unwrap().code(), Some(0), "{}", place.said());
    assert_eq!((place.jobs("labelled"), place.jobs("queued")), (labels, 0));
    assert_eq!(place.export(), bytes, "the same potential");
    let job = place.job(doubtful);
    assert_eq!((job.job.attempts, job.energies.len(), job.job.relabel), (2, 2, None));
    check(&place);
}

#[test]
fn a_killed_relabel_requests_all_structures_or_none() {
    let (place, labels) = labelled();
    let before = exported(&place);
    for kill in 0..8 {
        let mut running = place.start(&["relabel", place.argument(), "--all", "--include-current"]);
        std::thread::sleep(Duration::from_millis(random(kill) % 60));
        signal(running.0.id(), "KILL");
        running.0.wait().unwrap();
        assert!([0, labels].contains(&place.jobs("relabelling")), "{}", place.status());
    }
    relabel(&place, &["--all", "--include-current"]);
    assert_eq!(place.jobs("relabelling"), labels);
    // Kills of labellers do not lose jobs either.
    for kill in 0..4 {
        let mut running = place.label(&["--until-empty"]);
        std::thread::sleep(Duration::from_millis(random(100 + kill) % 400));
        running.0.kill().unwrap();
        running.0.wait().unwrap();
    }
    assert_eq!(place.label(&["--until-empty"]).0.wait().unwrap().code(), Some(0), "{}", place.said());
    assert_eq!((place.jobs("labelled"), place.jobs("relabelling")), (labels, 0));
    assert_eq!(exported(&place), before);
    check(&place);
}

#[test]
fn labellers_continue_with_the_new_protocol() {
    let (place, labels) = labelled();
    another_protocol(&place, "fine");
    let name = place.queue_large();
    let mut label = place.label(&[]);
    let slot = place.pause_labeller();
    relabel(&place, &["--config", "fine.toml", "--all"]);
    slot.resume();
    assert_eq!(label.0.wait().unwrap().code(), Some(0), "{}", place.said());
    assert!(place.said().contains("the campaign replaced label protocol 'potential'"), "{}", place.said());
    let job = place.job(&name).job;
    assert_eq!((job.protocol.as_str(), job.state), ("fine", JobState::Labelled));
    assert_eq!((place.jobs("labelled"), place.jobs("relabelling")), (labels + 1, 0));
    assert!(exported(&place).iter().all(|(protocol, _)| protocol == "fine"));
}
