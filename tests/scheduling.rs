//! The order in which walks are assigned, and idle walkers.

use std::fs;
use std::process::Stdio;

use serde_json::Value;
use store::Location;

use crate::common::campaign::Small;
use crate::common::label_campaign::on_store;
use crate::common::processes::wait_until;
use crate::common::{Running, program, succeed};

/// In live mode with a single walker.
#[test]
fn control_walks_do_not_wait_for_the_last_biased_walk() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let seeds = &["fcc-100", "vacancy", "fcc-103", "fcc-097", "bcc", "sheared"];
    Small { mode: "live", walkers: 1, steps: 120, max_per_walk: 1, seeds, ..Small::default() }.write(here);
    succeed(here, ["run", "campaign.toml"]);
    let (decisions, walks) = on_store(Location::from(&*here.join("campaign")), async |store| {
        (store.decisions(1..=i64::MAX).await.unwrap(), store.load_walks().await.unwrap())
    });
    let biased = |id| walks.iter().any(|walk| Some(walk.walk.0) == id && walk.partner.is_none());
    let ends: Vec<_> = decisions
        .iter()
        .filter(|decision| decision.kind == "ended" && biased(decision.walk))
        .map(|decision| decision.sequence)
        .collect();
    let control = decisions.iter().find(|decision| decision.kind == "control").unwrap().sequence;
    // The single walker starts the last biased walk after the one before it has ended.
    let [.., before_last, _] = ends[..] else { panic!("{ends:?}") };
    assert!(ends.len() == 6 && control < before_last, "{control}, {ends:?}");
}

#[test]
fn walkers_that_rounds_leave_idle_are_named_and_measured() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let small = Small { walkers: 4, walks_per_round: 1, steps: 1_000_000, ..Small::default() };
    // The threshold is too high to collect a structure.
    fs::write(small.write(here), small.text().replace("threshold = 1.0", "threshold = 1e6")).unwrap();
    let idle = "at most 2 of the 4 walkers have something to do at a time: a round has 1 biased walks (run.walks_per_round)";
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
