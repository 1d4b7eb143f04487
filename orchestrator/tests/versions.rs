//! Versions of the potential: walks make room for them, and start anew with them.

use orchestrator::selector::{CampaignMode, Scheduling, SelectorSettings, SelectorSnapshot};
use store::records::Commit;
use wire::WalkId;
use wire::messages::{Outcome, WalkEnd};

use crate::common::memory::MemoryStore;
use crate::common::{
    SHORTEST, at, decided, ended, kinds, next_assignment, offer, report, restore, settings, structure,
    try_restore, value, with_version,
};

const NEW: [f64; 3] = [0.0, 3.0, 0.0];

/// State and version of each walk in the store.
fn walks(store: &MemoryStore) -> Vec<(String, u32)> {
    store.walks.values().map(|walk| (walk.state.clone(), walk.conditions.version)).collect()
}

fn reproducible() -> SelectorSettings {
    settings(CampaignMode::Reproducible)
}

/// Three walks, two in the first round, whose first candidate is the structure for which a refit is due.
fn until_refit(settings: &SelectorSettings) -> (MemoryStore, Commit) {
    let mut store = MemoryStore::default();
    let mut selector = restore(settings, 3, SelectorSnapshot::default());
    store.commit(&selector.start_walks());
    let [first, second] = [(); 2].map(|()| next_assignment(&mut selector));
    assert!(selector.report(offer(&selector, &first, 5, structure(1, SHORTEST), NEW)).unwrap().is_none());
    let commit = decided(&mut selector, report(&second, Outcome::StepsDone, at(10)));
    store.commit(&commit);
    (store, commit)
}

#[test]
fn all_biased_walks_make_room_when_a_refit_is_due() {
    let (store, commit) = until_refit(&SelectorSettings { refit_at: Some(1), ..reproducible() });
    assert_eq!(kinds(&commit), ["accepted", "ended", "ended", "ended"]);
    assert_eq!(commit.decisions[1].detail["end"], "superseded");
    assert_eq!(walks(&store), [(); 3].map(|()| ("superseded".to_owned(), 0)));
    let selector = restore(&SelectorSettings { refit_at: Some(1), ..reproducible() }, 3, store.snapshot());
    assert!(selector.is_done());
}

#[test]
fn control_walks_run_to_their_end_before_a_version() {
    let settings = SelectorSettings { control: true, refit_at: Some(1), ..reproducible() };
    let (mut store, commit) = until_refit(&settings);
    assert_eq!(kinds(&commit), ["accepted", "ended", "ended", "ended", "begun"]);
    let mut selector = restore(&settings, 3, store.snapshot());
    let control = next_assignment(&mut selector);
    assert_eq!((control.walk, control.frame_steps.as_slice()), (WalkId(3), &[5][..]));
    let frame = offer(&selector, &control, 5, structure(2, SHORTEST), NEW);
    store.commit(&decided(&mut selector, frame));
    assert!(selector.is_done());
}

#[test]
fn every_walk_of_the_plan_starts_anew_with_a_version() {
    let first = SelectorSettings { refit_at: Some(1), ..reproducible() };
    let (mut store, _) = until_refit(&first);
    assert_eq!(store.values["mixture_version"], "1");
    let next = with_version(&reproducible(), 2);
    let mut selector = restore(&next, 3, store.snapshot());
    let commit = selector.start_walks();
    assert_eq!(kinds(&commit), ["version", "begun", "begun", "begun"]);
    let detail = serde_json::json!({ "version": 2, "parent": 1, "model": "model 2", "mixture": "mixture 2" });
    assert_eq!(commit.decisions[0].detail, detail);
    assert_eq!((commit.restart_mixture, commit.components.len()), (true, 0));
    assert_eq!((value(&commit, "mixture_version"), value(&commit, "version")), ("2", "2"));
    assert_eq!(selector.mixture().version(), 2);
    store.commit(&commit);
    assert_eq!(walks(&store)[3..], [(); 3].map(|()| ("waiting".to_owned(), 2)));
    assert_eq!(next_assignment(&mut selector).conditions.version, 2);
    // The same after a restart; another seed structure gets a walk with the version in force only.
    let mut selector = restore(&next, 4, store.snapshot());
    let commit = selector.start_walks();
    let begun: Vec<_> = commit.walks.iter().map(|walk| (walk.walk.0, walk.conditions.version)).collect();
    assert_eq!((kinds(&commit).join(" "), begun), ("begun".to_owned(), vec![(6, 2)]));
}

#[test]
fn superseded_walks_go_on_after_a_refused_version() {
    let (store, _) = until_refit(&SelectorSettings { refit_at: Some(1), ..reproducible() });
    let later = SelectorSettings { refit_at: Some(2), ..reproducible() };
    let mut selector = restore(&later, 3, store.snapshot());
    let commit = selector.start_walks();
    assert_eq!(kinds(&commit), ["resumed", "resumed", "resumed"]);
    let first = next_assignment(&mut selector);
    assert_eq!((first.walk, first.number, first.checkpoint.as_deref()), (WalkId(0), 1, Some(&b"step 5"[..])));
}

#[test]
fn walks_that_are_under_way_end_when_a_version_is_taken_up() {
    let (mut store, _) = until_refit(&SelectorSettings { control: true, ..reproducible() });
    let mut selector =
        restore(&with_version(&SelectorSettings { control: true, ..reproducible() }, 1), 3, store.snapshot());
    let commit = selector.start_walks();
    assert_eq!(kinds(&commit), ["ended", "ended", "ended", "version", "begun", "begun", "begun"]);
    store.commit(&commit);
    // No control walk begins with another version than its biased walk.
    let [first, second] = [(); 2].map(|()| next_assignment(&mut selector));
    assert!(selector.report(ended(&first, 10, WalkEnd::Completed)).unwrap().is_none());
    let commit = decided(&mut selector, ended(&second, 10, WalkEnd::Completed));
    assert_eq!(kinds(&commit), ["ended", "ended"]);
}

/// They would end at once.
#[test]
fn no_walk_starts_with_a_version_while_the_structures_of_the_campaign_are_used_up() {
    let limited = SelectorSettings { max_structures: Some(1), ..reproducible() };
    let (mut store, commit) = until_refit(&limited);
    assert_eq!((kinds(&commit).len(), commit.decisions[1].detail["end"].as_str()), (4, Some("budget")));
    let mut selector = restore(&with_version(&limited, 1), 3, store.snapshot());
    let commit = selector.start_walks();
    assert_eq!(kinds(&commit), ["version"]);
    assert!(selector.is_done());
    store.commit(&commit);
    let mut selector = restore(&with_version(&reproducible(), 1), 3, store.snapshot());
    assert_eq!(kinds(&selector.start_walks()), ["configuration", "begun", "begun", "begun"]);
}

#[test]
fn walks_of_new_seed_structures_wait_for_the_version_that_is_due() {
    let due = SelectorSettings { refit_at: Some(1), ..reproducible() };
    let (store, _) = until_refit(&due);
    let mut selector = restore(&due, 4, store.snapshot());
    assert!(selector.start_walks().decisions.is_empty());
    let mut selector = restore(&with_version(&reproducible(), 1), 4, store.snapshot());
    assert_eq!(selector.start_walks().walks.len(), 4);
}

/// Each version may collect as much from a seed structure as the first one.
#[test]
fn the_limit_of_a_seed_structure_holds_for_each_version() {
    let limited = SelectorSettings { max_per_seed_structure: Some(1), ..settings(CampaignMode::Live) };
    let mut store = MemoryStore::default();
    for version in 0..2 {
        let mut selector = restore(&with_version(&limited, version), 1, store.snapshot());
        store.commit(&selector.start_walks());
        let assignment = next_assignment(&mut selector);
        let number = u64::from(version) + 1;
        let report = offer(&selector, &assignment, 5, structure(number, SHORTEST), [0.0, 3.0, 0.0]);
        let commit = decided(&mut selector, report);
        assert_eq!(kinds(&commit), ["accepted", "ended"]);
        store.commit(&commit);
    }
    assert_eq!(store.known.len(), 2);
}

#[test]
fn live_walks_that_are_assigned_make_room_when_they_report() {
    let live = settings(CampaignMode::Live);
    let mut store = MemoryStore::default();
    let mut selector = restore(&live, 2, SelectorSnapshot::default());
    store.commit(&selector.start_walks());
    let assigned = next_assignment(&mut selector);
    let commit = selector.supersede_walks();
    assert_eq!((kinds(&commit), commit.walks[0].walk), (vec!["ended".to_owned()], WalkId(1)));
    assert!(matches!(selector.next_assignment(1), Scheduling::Wait));
    let commit = decided(&mut selector, report(&assigned, Outcome::StepsDone, at(10)));
    assert_eq!(kinds(&commit), ["ended"]);
    assert!(matches!(selector.next_assignment(1), Scheduling::Done));
}

#[test]
fn a_store_with_a_later_version_is_refused() {
    let mut store = MemoryStore::default();
    let mut selector = restore(&with_version(&reproducible(), 2), 1, SelectorSnapshot::default());
    store.commit(&selector.start_walks());
    let error = try_restore(&with_version(&reproducible(), 1), 1, None, store.snapshot()).err().unwrap();
    assert!(error.to_string().contains("version 2 of the potential, expected at most version 1"), "{error}");
}
