//! Walks end when they find nothing new for a number of steps together.

use orchestrator::selector::{CampaignMode, SeedStructurePlan, SelectorSettings, SelectorSnapshot};
use store::records::Commit;
use wire::WalkConditions;
use wire::messages::{Outcome, WalkProgress};

use crate::common::memory::MemoryStore;
use crate::common::{
    SHORTEST, at, begin, decided, kinds, next_assignment, offer, report, restore, restore_with,
    seed_structure, settings, structure, value, with_version,
};

const NEW: [f64; 3] = [0.0, 3.0, 0.0];
const COUNT: &str = "steps_without_structure";

fn limited(mode: CampaignMode, steps: u64) -> SelectorSettings {
    SelectorSettings { max_steps_without_structure: Some(steps), ..settings(mode) }
}

/// Three walks, two in a round, that find nothing in two rounds of ten steps each. The last commit.
fn until_nothing_new(settings: &SelectorSettings) -> (MemoryStore, Commit) {
    let mut store = MemoryStore::default();
    let mut selector = restore(settings, 3, SelectorSnapshot::default());
    store.commit(&selector.start_walks());
    let mut round = |steps| {
        let [first, second] = [(); 2].map(|()| next_assignment(&mut selector));
        assert!(selector.report(report(&first, Outcome::StepsDone, at(steps))).unwrap().is_none());
        let commit = decided(&mut selector, report(&second, Outcome::StepsDone, at(steps)));
        store.commit(&commit);
        commit
    };
    assert!(round(10).decisions.is_empty());
    let last = round(20);
    (store, last)
}

#[test]
fn all_biased_walks_end_and_go_on_with_a_larger_limit() {
    let settings = limited(CampaignMode::Reproducible, 40);
    let (store, commit) = until_nothing_new(&settings);
    assert_eq!((kinds(&commit), value(&commit, COUNT)), (vec!["ended".to_owned(); 3], "40"));
    assert!(commit.decisions.iter().all(|decision| decision.detail["end"] == "nothing_new"));
    // The same run comes to the same end, also with more seed structures.
    let mut same = restore(&settings, 4, store.snapshot());
    assert!(same.start_walks().decisions.is_empty() && same.is_done());
    let larger = limited(CampaignMode::Reproducible, 41);
    let mut selector = restore(&larger, 4, store.snapshot());
    assert_eq!(kinds(&selector.start_walks()), ["configuration", "resumed", "resumed", "resumed", "begun"]);
    assert_eq!(next_assignment(&mut selector).last_step, 30);
}

#[test]
fn a_version_of_the_potential_has_as_many_steps_again() {
    let settings = limited(CampaignMode::Reproducible, 40);
    let (store, _) = until_nothing_new(&settings);
    let mut selector = restore(&with_version(&settings, 1), 3, store.snapshot());
    let commit = selector.start_walks();
    assert_eq!(kinds(&commit), ["version", "begun", "begun", "begun"]);
    assert_eq!(value(&commit, COUNT), "0");
}

/// An interruption is no end of an assignment, steps behind a roll-back count once they are made again, and control walks do not
/// count.
#[test]
fn steps_count_from_the_last_structure() {
    let control = SelectorSettings { control: true, max_per_walk: 1, ..limited(CampaignMode::Live, 1000) };
    let mut selector = begin(&control, 1);
    let returned = WalkProgress { segment: 1, ..at(15) };
    for (outcome, progress, steps) in [
        (Outcome::StepsDone, at(10), "10"),
        (Outcome::Interrupted, at(14), ""),
        (Outcome::StepsDone, at(20), "20"),
        (Outcome::StepsDone, returned, "20"),
        (Outcome::StepsDone, WalkProgress { segment: 1, ..at(22) }, "27"),
    ] {
        let assignment = next_assignment(&mut selector);
        let is_counted = outcome != Outcome::Interrupted;
        let commit = decided(&mut selector, report(&assignment, outcome, progress));
        assert!(!is_counted || value(&commit, COUNT) == steps, "{steps}: {:?}", commit.values);
    }
    let assignment = next_assignment(&mut selector);
    let found = offer(&selector, &assignment, 25, structure(1, SHORTEST), NEW);
    let commit = decided(&mut selector, found);
    assert_eq!((kinds(&commit).join(" "), value(&commit, COUNT)), ("accepted ended begun".to_owned(), "0"));
    let control = next_assignment(&mut selector);
    let commit = decided(&mut selector, report(&control, Outcome::StepsDone, at(10)));
    assert_eq!(value(&commit, COUNT), "0");
}

#[test]
fn structures_of_live_walks_that_are_under_way_are_accepted_but_the_limit_stays_reached() {
    let live = limited(CampaignMode::Live, 10);
    let mut store = MemoryStore::default();
    let mut selector = restore(&live, 3, SelectorSnapshot::default());
    store.commit(&selector.start_walks());
    let [first, second] = [(); 2].map(|()| next_assignment(&mut selector));
    let commit = decided(&mut selector, report(&first, Outcome::StepsDone, at(10)));
    assert_eq!(kinds(&commit), ["ended", "ended"]);
    store.commit(&commit);
    let found = offer(&selector, &second, 5, structure(1, SHORTEST), NEW);
    let commit = decided(&mut selector, found);
    assert_eq!(kinds(&commit), ["accepted", "ended"]);
    assert_eq!(commit.decisions[1].detail["end"], "nothing_new");
    store.commit(&commit);
    let mut selector = restore(&live, 3, store.snapshot());
    assert!(selector.start_walks().decisions.is_empty() && selector.is_done());
}

/// Walks of other groups neither count nor start the count anew.
#[test]
fn steps_and_structures_of_some_groups_can_count_alone() {
    let settings = SelectorSettings { stop_groups: vec!["target".into()], ..limited(CampaignMode::Live, 20) };
    let seeds = ["target", "other"].into_iter().enumerate().map(|(number, group)| SeedStructurePlan {
        walks: vec![WalkConditions { group: group.into(), ..WalkConditions::default() }],
        ..seed_structure(number)
    });
    let mut selector = restore_with(&settings, seeds.collect(), SelectorSnapshot::default());
    selector.start_walks();
    let [target, other] = [(); 2].map(|()| next_assignment(&mut selector));
    let commit = decided(&mut selector, report(&other, Outcome::StepsDone, at(10)));
    assert_eq!(value(&commit, COUNT), "0");
    let commit = decided(&mut selector, report(&target, Outcome::StepsDone, at(10)));
    assert_eq!(value(&commit, COUNT), "10");
    let [target, other] = [(); 2].map(|()| next_assignment(&mut selector));
    let found = offer(&selector, &other, 15, structure(1, SHORTEST), NEW);
    let commit = decided(&mut selector, found);
    assert_eq!((kinds(&commit), value(&commit, COUNT)), (vec!["accepted".to_owned()], "10"));
    // All biased walks end with them.
    let commit = decided(&mut selector, report(&target, Outcome::StepsDone, at(20)));
    assert_eq!((kinds(&commit), value(&commit, COUNT)), (vec!["ended".to_owned(); 2], "20"));
}
