//! `calmwalk exclude`: a bad label is left out of exports and statistics, and all views show that it is excluded.

use std::path::Path;

use serde_json::Value as Json;
use tempfile::TempDir;

use crate::common::campaign::Small;
use crate::common::{refuse, succeed};

fn campaign() -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    Small::default().write(directory.path());
    succeed(directory.path(), ["run", "campaign.toml", "--directory", "here"]);
    directory
}

fn json<const N: usize>(here: &Path, arguments: [&str; N]) -> Json {
    serde_json::from_str(&succeed(here, arguments.into_iter().chain(["--json"]))).unwrap()
}

/// Candidates in an export, and its standard output.
fn exported(here: &Path) -> (Vec<String>, String) {
    let said = succeed(here, ["export", "here", "--output", "out.extxyz"]);
    let frames = atoms::read_extxyz(&here.join("out.extxyz")).unwrap();
    (frames.iter().map(|frame| frame.info["candidate_id"].text().unwrap().to_owned()).collect(), said)
}

#[test]
fn a_bad_label_is_left_out_until_it_is_included_again() {
    let directory = campaign();
    let here = directory.path();
    let (before, _) = exported(here);
    assert!(before.len() > 2);
    let bad = before[1].as_str();
    let (errors, report) = (json(here, ["force-errors", "here"]), "the SCF loop had two solutions");
    // The id may omit the campaign.
    let short = bad.split_once('-').unwrap().1;
    let said = succeed(here, ["exclude", "here", short, "--reason", report]);
    assert!(
        said.starts_with(&format!("{bad}: label of 'potential' excluded from exports and statistics")),
        "{said}"
    );
    let said = succeed(here, ["exclude", "here", bad, "--reason", "once more"]);
    assert_eq!(said, format!("{bad}: label of 'potential' was already excluded: {report}\n"));

    let (left, said) = exported(here);
    assert!(!left.contains(&bad.to_owned()) && left.len() == before.len() - 1, "{left:?}");
    assert!(said.contains("not exported: 1 with excluded labels"), "{said}");
    let now = json(here, ["force-errors", "here"]);
    let structures = |errors: &Json, key: &str| errors[key]["structures"].as_u64().unwrap();
    assert_eq!(structures(&now, "biased"), structures(&errors, "biased") - 1);
    let used = |errors: &Json| errors["energy"]["offsets"]["structures"].as_u64().unwrap();
    assert_eq!(used(&now), used(&errors) - 1);
    let completed = |errors: &Json| -> u64 {
        let bins = errors["completion_by_gamma"].as_array().unwrap();
        bins.iter().map(|bin| bin["labelled"].as_u64().unwrap()).sum()
    };
    assert!(completed(&now) < completed(&errors));

    // Every view of the label or the campaign shows it.
    let status = json(here, ["status", "here"]);
    assert_eq!(status["labels"]["excluded"], 1);
    assert!(succeed(here, ["status", "here"]).contains("1 label excluded"));
    let shown = succeed(here, ["queue", "here", "show", bad]);
    assert!(shown.contains(&format!("excluded  from exports and statistics: {report}")), "{shown}");
    let listed = succeed(here, ["queue", "here", "list", "--limit", "1000"]);
    let line = listed.lines().find(|line| line.starts_with(bad)).unwrap();
    assert!(line.contains("labelled, excluded") && listed.matches("excluded").count() == 1, "{listed}");
    let details = succeed(here, ["explain", "here", bad]);
    for part in
        ["excluded from exports and statistics", "by the user: exclude (the SCF loop had two solutions)"]
    {
        assert!(details.contains(part), "{details}");
    }
    let excluded = json(here, ["exclude", "here", "--list"]);
    assert_eq!((&excluded[0]["id"], &excluded[0]["reason"]), (&bad.into(), &report.into()));
    assert!(succeed(here, ["run", "campaign.toml", "--directory", "here"]).contains("1 excluded by hand"));
    // `queue drop` refuses structures with labels, and names the right command.
    let message = refuse(here, ["queue", "here", "drop", bad]);
    assert!(message.contains("use calmwalk exclude to take its label out of the data set"), "{message}");

    let said = succeed(here, ["exclude", "here", bad, "--undo"]);
    assert_eq!(said, format!("{bad}: label of 'potential' included again\n"));
    assert_eq!(exported(here).0, before);
    assert_eq!(json(here, ["force-errors", "here"]), errors);
    let details = succeed(here, ["explain", "here", bad]);
    assert!(
        details.contains("by the user: include") && !details.contains("excluded from exports"),
        "{details}"
    );
    assert_eq!(succeed(here, ["exclude", "here", "--list"]), "no excluded labels\n");
    succeed(here, ["store", "check", "here"]);
}

#[test]
fn what_cannot_be_excluded_is_refused_and_nothing_changes() {
    let directory = campaign();
    let here = directory.path();
    let (names, _) = exported(here);
    for (arguments, expected) in [
        (vec!["exclude", "here"], "<ID>"),
        (vec!["exclude", "here", &names[0]], "--reason <TEXT>"),
        (vec!["exclude", "here", &names[0], "--reason", " "], "expected a reason"),
        (vec!["exclude", "here", &names[0], "--reason", "x", "--undo"], "cannot be used with"),
        (vec!["exclude", "here", &names[0], "99.0.1", "--reason", "x"], "no candidate matches '99.0.1'"),
        (vec!["exclude", "here", "import-1", "--reason", "x"], "no imported structure matches 'import-1'"),
        (vec!["exclude", "nowhere", &names[0], "--reason", "x"], "nowhere"),
    ] {
        let message = refuse(here, &arguments);
        assert!(message.contains(expected), "{arguments:?}: {message}");
    }
    assert_eq!(exported(here).0, names);
}
