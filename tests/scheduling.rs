//! The order in which walks are assigned, and idle walkers.

use std::fs;
use std::path::Path;
use std::process::Stdio;

use serde_json::Value;
use store::{Location, LoggedDecision};

use crate::common::campaign::Small;
use crate::common::label_campaign::on_store;
use crate::common::processes::wait_until;
use crate::common::{Running, program, succeed};

/// The decisions of a campaign, each with whether it is about a control walk.
fn decisions(here: &Path) -> Vec<(LoggedDecision, bool)> {
    on_store(Location::from(&*here.join("campaign")), async |store| {
        let walks = store.load_walks().await.unwrap();
        let is_control = |decision: &LoggedDecision| {
            walks.iter().any(|walk| Some(walk.walk.0) == decision.walk && walk.partner.is_some())
        };
        let decisions = store.decisions(1..=i64::MAX).await.unwrap().into_iter();
        let with_control = |decision| {
            let control = is_control(&decision);
            (decision, control)
        };
        decisions.map(with_control).collect()
    })
}

/// In live mode with a single walker.
#[test]
fn control_walks_do_not_wait_for_the_last_biased_walk() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let seed_structures = &["fcc-100", "vacancy", "fcc-103", "fcc-097", "bcc", "sheared"];
    Small { mode: "live", walkers: 1, steps: 120, max_per_walk: 1, seed_structures, ..Small::default() }
        .write(here);
    succeed(here, ["run", "campaign.toml"]);
    let decisions = decisions(here);
    let ends: Vec<_> = decisions
        .iter()
        .filter(|(decision, control)| decision.kind == "ended" && !control)
        .map(|(decision, _)| decision.sequence)
        .collect();
    let (control, _) = decisions.iter().find(|(decision, _)| decision.kind == "control").unwrap();
    let control = control.sequence;
    // The single walker starts the last biased walk after the one before it has ended.
    let [.., before_last, _] = ends[..] else { panic!("{ends:?}") };
    assert!(ends.len() == 6 && control < before_last, "{control}, {ends:?}");
}

/// In live mode with a single walker: with the whole share a control walk is the next, with next to none it is the last.
#[test]
fn the_share_of_control_walks_decides_when_they_walk() {
    for (share, are_last) in [("1.0", false), ("0.001", true)] {
        let directory = tempfile::tempdir().unwrap();
        let here = directory.path();
        let seed_structures = &["fcc-100", "vacancy", "fcc-103", "fcc-097"];
        let small = Small {
            mode: "live",
            walkers: 1,
            steps: 120,
            max_per_walk: 1,
            seed_structures,
            ..Small::default()
        };
        let text = small.text().replace("[campaign]", &format!("[campaign]\ncontrol_share = {share}"));
        fs::write(small.write(here), text).unwrap();
        succeed(here, ["run", "campaign.toml"]);
        let decisions = decisions(here);
        let begun = |(decision, control): &(LoggedDecision, bool)| *control && decision.kind == "begun";
        let first = decisions.iter().position(begun).expect("a control walk");
        let next_is_control = decisions[first + 1].1;
        let walked = decisions.iter().filter(|(decision, _)| decision.kind != "begun");
        let walked: Vec<bool> = walked.map(|(_, control)| *control).collect();
        assert_eq!((next_is_control, walked.is_sorted()), (!are_last, are_last), "{share}: {walked:?}");
        assert!(walked.contains(&true), "{share}: {walked:?}");
    }
}

#[test]
fn walkers_that_too_few_walks_leave_idle_are_named() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    for (mode, walkers, walks_per_round, control, expected) in [
        ("live", 4, 1, true, Some(", each followed by its control walk")),
        ("live", 2, 1, true, None),
        ("reproducible", 3, 3, false, Some("")),
    ] {
        let small = Small { mode, walkers, walks_per_round, ..Small::default() };
        let text = small.text().replace("[campaign]", &format!("[campaign]\ncontrol = {control}"));
        fs::write(small.write(here), text).unwrap();
        let shown = succeed(here, ["validate", "campaign.toml"]);
        let Some(controls) = expected else {
            assert!(!shown.contains("have something to do"), "{mode}: {shown}");
            continue;
        };
        let idle = format!(
            "  walkers          at most 2 of the {walkers} walkers have something to do at a time: the campaign has 2 \
             biased walks{controls}\n"
        );
        assert!(shown.contains(&idle), "{mode}: {shown}");
    }
}

#[test]
fn walkers_that_rounds_leave_idle_are_named_and_measured() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let small = Small { walkers: 4, walks_per_round: 1, steps: 1_000_000, ..Small::default() };
    // The threshold is too high to collect a structure.
    fs::write(small.write(here), small.text().replace("threshold = 1.0", "threshold = 1e6")).unwrap();
    let idle = "at most 2 of the 4 walkers have something to do at a time: a round has 1 biased walk (run.walks_per_round)";
    let shown = succeed(here, ["validate", "campaign.toml"]);
    assert!(shown.contains(&format!("  walkers          {idle}")), "{shown}");
    let said = fs::File::create(here.join("said")).unwrap();
    let run = program(here).args(["run", "campaign.toml"]).stderr(said).stdout(Stdio::null()).spawn();
    let run = Running(run.unwrap());
    wait_until("the share of busy walkers is known", || {
        if !here.join("campaign/campaign.sqlite").exists() {
            return false;
        }
        let status: Value = serde_json::from_str(&succeed(here, ["status", "campaign", "--json"])).unwrap();
        let busy = status["walkers_busy"].as_f64();
        assert!(busy.is_none_or(|busy| (0.0..=1.0).contains(&busy)), "{status}");
        busy > Some(0.0)
    });
    drop(run);
    let said = fs::read_to_string(here.join("said")).unwrap();
    assert!(said.contains(&format!("WARNING: {idle}")), "{said}");
}
