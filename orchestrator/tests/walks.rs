//! Walks in assignments and rounds: starts, waiting, control walks, rollbacks, losses, ends.

use orchestrator::selector::{
    CampaignMode, Scheduling, Selector, SelectorSettings, SelectorSnapshot, UpdateProtocol,
};
use store::records::{AssignmentRecord, ComponentRecord, Fate};
use wire::messages::{Assignment, AssignmentReport, AssignmentStart, Outcome, WalkEnd, WalkProgress};
use wire::{Origin, TracePoint, WalkFrame, WalkId};

use crate::common;
use crate::common::memory::MemoryStore;
use crate::common::{
    SHORTEST, at, begin, decided, ended, kinds, next_assignment, offer, restore, settings, structure,
    try_restore, value,
};

const NEW: [f64; 3] = [0.0, 3.0, 0.0];

fn is_waiting(selector: &mut Selector) -> bool {
    matches!(selector.next_assignment(0), Scheduling::Wait)
}

#[test]
fn every_seed_structure_gets_one_walk() {
    let mut store = MemoryStore::default();
    let mut selector = restore(&settings(CampaignMode::Live), 2, SelectorSnapshot::default());
    assert!(selector.is_done(), "no walks yet");
    let commit = selector.start_walks();
    assert_eq!(kinds(&commit), ["begun", "begun"]);
    assert_eq!(commit.decisions[1].detail["seed_structure"], "seed-1");
    store.commit(&commit);
    assert!(selector.start_walks().walks.is_empty());
    // Another seed structure is added to the campaign.
    let mut selector = restore(&settings(CampaignMode::Live), 3, store.snapshot());
    let commit = selector.start_walks();
    assert_eq!(
        (kinds(&commit), commit.walks[0].walk, commit.walks[0].seed_structure),
        (vec!["begun".into()], WalkId(2), 2)
    );
    let assignments = [(); 3].map(|()| next_assignment(&mut selector));
    for (seed, assignment) in assignments.iter().enumerate() {
        assert_eq!(assignment.seed_structure, common::seed_structure(seed).structure);
        assert_eq!((assignment.campaign, assignment.random_walk), (common::CAMPAIGN, assignment.walk));
        assert_eq!((assignment.number, assignment.last_step, assignment.checkpoint.is_none()), (0, 10, true));
    }
    assert!(is_waiting(&mut selector));
    let names: Vec<_> = selector.walk_progress(100).into_iter().map(|(_, name, step)| (name, step)).collect();
    assert_eq!(names, [("seed-0".into(), 0), ("seed-1".into(), 0), ("seed-2".into(), 0)]);
}

#[test]
fn complete_rounds_are_decided_in_walk_order() {
    let mut selector = begin(&settings(CampaignMode::Reproducible), 3);
    let (first, second) = (next_assignment(&mut selector), next_assignment(&mut selector));
    assert!(is_waiting(&mut selector), "the third walk is not in the round");
    let reports = [
        offer(&selector, &second, 5, structure(2, SHORTEST), NEW),
        offer(&selector, &first, 6, structure(1, SHORTEST), NEW),
    ];
    let [later, earlier] = reports;
    assert!(selector.report(later).unwrap().is_none());
    assert!(is_waiting(&mut selector));
    let commit = decided(&mut selector, earlier);
    assert_eq!(kinds(&commit), ["accepted", "declined covered"]);
    let walks: Vec<_> = commit.decisions.iter().map(|decision| (decision.walk, decision.round)).collect();
    assert_eq!(walks, [(Some(WalkId(0)), 1), (Some(WalkId(1)), 1)]);
    assert_eq!((value(&commit, "round"), selector.mixture().version()), ("1", 1));
    // A walk that ends makes room for the next.
    let (first, second) = (next_assignment(&mut selector), next_assignment(&mut selector));
    assert!(selector.report(ended(&first, 20, WalkEnd::Completed)).unwrap().is_none());
    decided(&mut selector, common::report(&second, Outcome::StepsDone, at(15)));
    assert_eq!(
        [next_assignment(&mut selector).walk, next_assignment(&mut selector).walk],
        [WalkId(1), WalkId(2)]
    );
}

/// Lost and interrupted walks are given out again before later ones; paused ones when they are resumed; those that have
/// reported not at all.
#[test]
fn walks_of_a_round_are_assigned_in_order_whatever_happens_to_them() {
    let four = SelectorSettings { walks_per_round: 4, ..settings(CampaignMode::Reproducible) };
    let mut selector = begin(&four, 5);
    selector.set_paused([WalkId(1)].into());
    let [first, third] = [(); 2].map(|()| next_assignment(&mut selector));
    assert_eq!([first.walk, third.walk], [WalkId(0), WalkId(2)]);
    selector.assignment_lost(third.walk);
    decided(&mut selector, common::report(&first, Outcome::Interrupted, at(4)));
    selector.set_paused([].into());
    let assignments = [(); 4].map(|()| next_assignment(&mut selector));
    assert_eq!(assignments.each_ref().map(|assignment| assignment.walk.0), [0, 1, 2, 3]);
    assert!(is_waiting(&mut selector), "the fifth walk is not in the round");
    let [rest @ .., last] = assignments.map(|a| common::report(&a, Outcome::StepsDone, at(10)));
    for report in rest {
        let walk = report.walk;
        assert!(selector.report(report).unwrap().is_none());
        selector.assignment_lost(walk);
        assert!(is_waiting(&mut selector));
    }
    decided(&mut selector, last);
    let next = next_assignment(&mut selector);
    assert_eq!((next.walk, next.number), (WalkId(0), 1));
}

#[test]
fn live_walks_do_not_wait_for_each_other() {
    let mut selector = begin(&settings(CampaignMode::Live), 3);
    let assignments = [(); 3].map(|()| next_assignment(&mut selector));
    for assignment in assignments.iter().rev() {
        let report = offer(&selector, assignment, 5, structure(assignment.walk.0.into(), SHORTEST), NEW);
        let commit = decided(&mut selector, report);
        assert_eq!(commit.decisions[0].walk, Some(assignment.walk));
        assert_eq!(commit.decisions[0].round, 0);
        assert_eq!(
            next_assignment(&mut selector).walk,
            assignment.walk,
            "its next assignment is available at once"
        );
    }
}

#[test]
fn unsolicited_reports_change_nothing() {
    let mut selector = begin(&settings(CampaignMode::Live), 1);
    let assignment = next_assignment(&mut selector);
    let unasked = |selector: &mut Selector, report| {
        assert!(selector.report(report).unwrap().is_none());
    };
    let report = common::report(&assignment, Outcome::StepsDone, at(10));
    unasked(&mut selector, wire::messages::AssignmentReport { walk: WalkId(1), ..report.clone() });
    unasked(&mut selector, wire::messages::AssignmentReport { assignment: 1, ..report.clone() });
    decided(&mut selector, report.clone());
    unasked(&mut selector, report.clone());
    next_assignment(&mut selector);
    unasked(&mut selector, report);
    // Reported twice in one round.
    let mut selector = begin(&settings(CampaignMode::Reproducible), 2);
    let [first, second] = [(); 2]
        .map(|()| next_assignment(&mut selector))
        .map(|a| common::report(&a, Outcome::StepsDone, at(10)));
    assert!(selector.report(first.clone()).unwrap().is_none());
    unasked(&mut selector, first);
    decided(&mut selector, second.clone());
    unasked(&mut selector, second);
}

#[test]
fn late_reports_of_lost_walkers_count_once() {
    for mode in [CampaignMode::Live, CampaignMode::Reproducible] {
        let mut selector = begin(&settings(mode), 1);
        let assignment = next_assignment(&mut selector);
        let report = common::report(&assignment, Outcome::StepsDone, at(10));
        selector.assignment_lost(assignment.walk);
        let commit = decided(&mut selector, report.clone());
        assert_eq!(commit.walks[0].assignments, assignment.number + 1);
        assert!(selector.report(report.clone()).unwrap().is_none());
        assert_eq!(next_assignment(&mut selector).number, assignment.number + 1);
        assert!(selector.report(report).unwrap().is_none());
        // Reports after the end of a walk are ignored.
        selector.assignment_lost(assignment.walk);
        let last = next_assignment(&mut selector);
        decided(&mut selector, ended(&last, 30, WalkEnd::Completed));
        assert!(selector.report(ended(&last, 30, WalkEnd::Completed)).unwrap().is_none());
    }
}

#[test]
fn assignments_of_lost_walkers_are_assigned_again() {
    for mode in [CampaignMode::Live, CampaignMode::Reproducible] {
        let mut selector = begin(&settings(mode), 1);
        let first = next_assignment(&mut selector);
        assert!(is_waiting(&mut selector));
        selector.assignment_lost(first.walk);
        let second = next_assignment(&mut selector);
        assert_eq!(first, second);
        selector.assignment_lost(WalkId(7));
        let commit = decided(&mut selector, ended(&second, 30, WalkEnd::Completed));
        assert_eq!(kinds(&commit), ["ended"]);
        selector.assignment_lost(second.walk);
        assert!(
            matches!(selector.next_assignment(0), Scheduling::Done),
            "what has ended is not given out again"
        );
    }
}

#[test]
fn the_points_of_every_report_are_committed_with_it() {
    let point = |number| TracePoint { number, ..TracePoint::default() };
    let traced = |assignment: &Assignment, outcome, numbers: &[u64]| AssignmentReport {
        trace: numbers.iter().copied().map(point).collect(),
        ..common::report(assignment, outcome, at(10))
    };
    let numbers = |commit: &store::records::Commit| -> Vec<(u32, Vec<u64>)> {
        let traces = commit.traces.iter();
        traces.map(|(walk, points)| (walk.0, points.iter().map(|point| point.number).collect())).collect()
    };
    let mut selector = begin(&settings(CampaignMode::Reproducible), 2);
    let [first, second] = [(); 2].map(|()| next_assignment(&mut selector));
    let interrupted = decided(&mut selector, traced(&second, Outcome::Interrupted, &[0, 1]));
    assert_eq!(numbers(&interrupted), [(1, vec![0, 1])]);
    let second = next_assignment(&mut selector);
    assert!(selector.report(traced(&second, Outcome::StepsDone, &[2])).unwrap().is_none());
    let commit = decided(&mut selector, traced(&first, Outcome::StepsDone, &[0]));
    assert_eq!(numbers(&commit), [(0, vec![0]), (1, vec![2])]);
}

/// What walkers began assignments with, and where these ended: with every report, in both modes.
#[test]
fn assignments_are_recorded_with_their_reports() {
    let frame = |step| WalkFrame { step, ..WalkFrame::default() };
    let from = |assignment: &Assignment, outcome, steps: [u64; 2], mixture_version| AssignmentReport {
        frames: vec![frame(steps[0]), frame(steps[1])],
        start: Some(AssignmentStart {
            position: at(steps[0]).position(),
            mixture_version,
            threshold_factor: assignment.threshold_factor,
            verdict: assignment.verdict.clone(),
        }),
        ..common::report(assignment, outcome, at(steps[1]))
    };
    let recorded = |commit: &store::records::Commit| -> Vec<[u64; 5]> {
        let row = |one: &AssignmentRecord| {
            let [begin, end] = [one.start.position.step, one.end.step];
            [one.part, one.number, one.start.mixture_version, begin, end]
        };
        // Each record has the frames of its steps.
        let parts = commit.trajectories.iter().map(|part| (part.part, part.frames.clone()));
        let frames = |one: &AssignmentRecord| vec![frame(one.start.position.step), frame(one.end.step)];
        let expected = commit.assignments.iter().map(|one| (one.part, frames(one)));
        assert_eq!(parts.collect::<Vec<_>>(), expected.collect::<Vec<_>>());
        commit.assignments.iter().map(row).collect()
    };
    for mode in [CampaignMode::Live, CampaignMode::Reproducible] {
        let mut store = MemoryStore::default();
        let mut selector = restore(&settings(mode), 1, SelectorSnapshot::default());
        store.commit(&selector.start_walks());
        let assignment = next_assignment(&mut selector);
        let commit = decided(&mut selector, from(&assignment, Outcome::Interrupted, [0, 4], 3));
        assert_eq!(recorded(&commit), [[0, 0, 3, 0, 4]]);
        store.commit(&commit);
        // The numbers go on after a restart.
        let mut selector = restore(&settings(mode), 1, store.snapshot());
        let assignment = next_assignment(&mut selector);
        let commit = decided(&mut selector, from(&assignment, Outcome::StepsDone, [4, 10], 5));
        assert_eq!(recorded(&commit), [[1, 0, 5, 4, 10]]);
        // A walker that made no step has nothing to record.
        let assignment = next_assignment(&mut selector);
        let commit = decided(&mut selector, common::report(&assignment, Outcome::Interrupted, at(10)));
        assert_eq!(recorded(&commit), [[0; 5]; 0]);
        let assignment = next_assignment(&mut selector);
        let ended = Outcome::Ended(WalkEnd::Completed);
        let commit = decided(&mut selector, from(&assignment, ended, [10, 20], 5));
        assert_eq!(recorded(&commit), [[2, 1, 5, 10, 20]]);
    }
}

/// Their records would not begin at the start of the walk.
#[test]
fn assignments_of_walks_of_earlier_versions_are_not_recorded() {
    let mut store = MemoryStore::default();
    let mut selector = restore(&settings(CampaignMode::Live), 1, SelectorSnapshot::default());
    let mut commit = selector.start_walks();
    for walk in &mut commit.walks {
        let mut state: serde_json::Value = serde_json::from_str(&walk.selector_state).unwrap();
        assert_eq!(state.as_object_mut().unwrap().remove("records"), Some(0.into()));
        walk.selector_state = state.to_string();
    }
    store.commit(&commit);
    let mut selector = restore(&settings(CampaignMode::Live), 1, store.snapshot());
    let assignment = next_assignment(&mut selector);
    let start = AssignmentStart {
        position: at(0).position(),
        mixture_version: 0,
        threshold_factor: 1.0,
        verdict: None,
    };
    let frames = vec![WalkFrame::default()];
    let report = AssignmentReport {
        start: Some(start),
        frames,
        ..common::report(&assignment, Outcome::StepsDone, at(10))
    };
    let commit = decided(&mut selector, report);
    assert!(commit.assignments.is_empty() && commit.trajectories.is_empty());
}

fn returned(segment: u32, step: u64) -> WalkProgress {
    WalkProgress { segment, rollbacks: segment, tau: 0.125, last_rollback: Some((7, 3)), ..at(step) }
}

#[test]
fn rollbacks_are_logged_once() {
    let mut selector = begin(&settings(CampaignMode::Live), 1);
    let assignment = next_assignment(&mut selector);
    let commit = decided(&mut selector, common::report(&assignment, Outcome::StepsDone, returned(2, 8)));
    assert_eq!(kinds(&commit), ["segment"]);
    let detail = &commit.decisions[0].detail;
    assert_eq!(
        *detail,
        serde_json::json!({ "segment": 2, "from": 7, "to": 3, "tau": 0.125, "rollbacks": 2 })
    );
    assert_eq!(commit.walks[0].progress.segment, 2);
    let assignment = next_assignment(&mut selector);
    assert_eq!(assignment.last_step, 18);
    let commit = decided(&mut selector, common::report(&assignment, Outcome::StepsDone, returned(2, 18)));
    assert_eq!(kinds(&commit), [""; 0]);
}

/// An interruption after a rollback does not remove the rollback from the log.
#[test]
fn rollbacks_before_an_interruption_are_logged() {
    let mut store = MemoryStore::default();
    let mut selector = restore(&settings(CampaignMode::Live), 1, SelectorSnapshot::default());
    store.commit(&selector.start_walks());
    let assignment = next_assignment(&mut selector);
    store.commit(&decided(&mut selector, common::report(&assignment, Outcome::Interrupted, returned(1, 4))));
    let mut selector = restore(&settings(CampaignMode::Live), 1, store.snapshot());
    let assignment = next_assignment(&mut selector);
    let commit = decided(&mut selector, common::report(&assignment, Outcome::StepsDone, returned(1, 10)));
    assert_eq!(kinds(&commit), ["segment"]);
}

#[test]
fn every_end_is_logged_with_its_reason() {
    let reason = || "forces are not finite".to_owned();
    let ends = [
        (WalkEnd::Completed, "completed", ""),
        (
            WalkEnd::Trapped { guard: "shortest-bond".into() },
            "trapped",
            "rejected by the shortest-bond guard again and again",
        ),
        (WalkEnd::Diverged { reason: reason() }, "diverged", "forces are not finite"),
        (WalkEnd::InvalidStart { reason: reason() }, "invalid_start", "forces are not finite"),
    ];
    let mut selector = begin(&settings(CampaignMode::Live), ends.len());
    let assignments = [(); 4].map(|()| next_assignment(&mut selector));
    for (assignment, (end, name, reason)) in assignments.iter().zip(ends) {
        let commit = decided(&mut selector, ended(assignment, 3, end));
        let detail = &commit.decisions[0].detail;
        // A walk that could not be resumed keeps its step.
        let step = if name == "invalid_start" { 0 } else { 3 };
        assert_eq!(
            *detail,
            serde_json::json!({ "end": name, "reason": reason, "step": step, "accepted": 0 })
        );
        assert_eq!((commit.walks[0].state.as_str(), commit.walks[0].reason.as_str()), (name, reason));
    }
    assert!(selector.is_done());
}

/// A walk that cannot go on from its checkpoint reports no progress: it keeps what it had.
#[test]
fn a_walk_that_cannot_go_on_keeps_its_step() {
    let mut selector = begin(&settings(CampaignMode::Live), 1);
    let assignment = next_assignment(&mut selector);
    let progress = WalkProgress { step: 10, ..WalkProgress::default() };
    decided(&mut selector, common::report(&assignment, Outcome::StepsDone, progress.clone()));
    let assignment = next_assignment(&mut selector);
    let diverged = Outcome::Ended(WalkEnd::Diverged { reason: "unreadable".into() });
    let report = AssignmentReport {
        checkpoint: assignment.checkpoint.clone().unwrap(),
        ..common::report(&assignment, diverged, WalkProgress::default())
    };
    let commit = decided(&mut selector, report);
    assert_eq!(commit.walks[0].progress, progress);
    assert_eq!(commit.decisions[0].detail["step"], 10);
}

/// With control walks: collects at these steps, and then ends the biased walk.
fn with_control(store: &mut MemoryStore, steps: &[u64]) -> Selector {
    let controlled = SelectorSettings {
        control: true,
        max_per_walk: 9,
        update: UpdateProtocol::Never,
        ..settings(CampaignMode::Reproducible)
    };
    let mut selector = restore(&controlled, 1, SelectorSnapshot::default());
    store.commit(&selector.start_walks());
    for (number, step) in (1..).zip(steps) {
        let assignment = next_assignment(&mut selector);
        let report = offer(&selector, &assignment, *step, structure(number, SHORTEST), NEW);
        store.commit(&decided(&mut selector, report));
    }
    let assignment = next_assignment(&mut selector);
    let commit = decided(&mut selector, ended(&assignment, 30, WalkEnd::Diverged { reason: "hot".into() }));
    store.commit(&commit);
    selector
}

/// Control walks get their share of the assignments, and biased walks the rest.
#[test]
fn control_walks_do_not_wait_behind_all_seed_structures() {
    let live = |control_share| SelectorSettings {
        control: true,
        max_per_walk: 1,
        control_share,
        update: UpdateProtocol::Never,
        ..settings(CampaignMode::Live)
    };
    for (share, expected) in
        [(0.5, [0, 1, 1, 2, 2, 3]), (0.25, [0, 0, 0, 1, 1, 1]), (1.0, [1, 2, 3, 4, 4, 4])]
    {
        let mut selector = begin(&live(share), 20);
        // Four biased walks collect a structure each, and get their control walks.
        let assignments = [(); 4].map(|()| next_assignment(&mut selector));
        for (number, assignment) in (1..).zip(&assignments) {
            let report = offer(&selector, assignment, 5, structure(number, SHORTEST), NEW);
            assert_eq!(kinds(&decided(&mut selector, report)), ["accepted", "ended", "begun"]);
        }
        let mut controls = 0;
        let counts = [(); 6].map(|()| {
            controls += u32::from(next_assignment(&mut selector).origin == Origin::Control);
            controls
        });
        assert_eq!(counts, expected, "share {share}");
    }
}

#[test]
fn control_walks_provide_frames_at_the_steps_of_the_biased_walk() {
    let mut store = MemoryStore::default();
    // After a rollback, a step can occur twice.
    let mut selector = with_control(&mut store, &[5, 12, 5]);
    let begun = store.decisions.last().unwrap();
    assert_eq!((begun.kind, begun.walk), ("begun", Some(WalkId(1))));
    assert_eq!(begun.detail, serde_json::json!({ "control_of": 0, "wanted": [5, 12] }));
    // Assignments are no longer than usual, and end at the last requested frame.
    for (step, wanted, until, kinds_then) in
        [(5, vec![5, 12], 10, vec!["control"]), (12, vec![12], 12, vec!["control", "ended"])]
    {
        let assignment = next_assignment(&mut selector);
        assert_eq!(
            (assignment.walk, assignment.origin, assignment.random_walk),
            (WalkId(1), Origin::Control, WalkId(0))
        );
        assert_eq!((assignment.frame_steps.clone(), assignment.last_step), (wanted, until));
        assert_eq!(assignment.seed_structure, common::seed_structure(0).structure);
        // An unremarkable structure: a control frame is recorded whatever its grade.
        let report = offer(&selector, &assignment, step, structure(100 + step, SHORTEST), [0.1; 3]);
        let commit = decided(&mut selector, report);
        assert_eq!(kinds(&commit), kinds_then);
        let candidate = &commit.candidates[0];
        assert_eq!((candidate.fate, candidate.keep_features), (Fate::Accepted, true));
        assert!(candidate.priority < 10, "labels of the campaign come first");
        assert!(candidate.selector.gamma.len() == 2 && candidate.original.gamma.len() == 2);
        store.commit(&commit);
    }
    assert!(matches!(selector.next_assignment(0), Scheduling::Done), "a control has no control");
    assert_eq!(store.walks[&WalkId(1)].state, "quota_reached");
    assert_eq!(store.known.len(), 3, "control frames are not what later candidates are compared with");
}

/// The frame is not labelled. The walk continues to its later frames, which are still matched by step.
#[test]
fn a_control_frame_with_atoms_too_close_is_left_out() {
    let mut store = MemoryStore::default();
    let mut selector = with_control(&mut store, &[5, 7, 9]);
    let least = 0.75 * SHORTEST;
    for (step, distance, expected) in [
        (5, least + 1e-6, vec!["control"]),
        (7, least - 1e-6, vec!["left_out"]),
        (9, 0.5, vec!["left_out", "ended"]),
    ] {
        let assignment = next_assignment(&mut selector);
        assert_eq!((assignment.origin, assignment.frame_steps[0]), (Origin::Control, step));
        let report = offer(&selector, &assignment, step, structure(100 + step, distance), [0.1; 3]);
        let commit = decided(&mut selector, report);
        assert_eq!(kinds(&commit), expected);
        if expected[0] == "left_out" {
            let detail = &commit.decisions[0].detail;
            let why = detail["error"].as_str().unwrap();
            let expected = format!("Al-Al atoms at {distance:.3} Å, closer than the limit of {least:.3} Å");
            assert!(why.contains(&expected) && detail["step"] == step, "{detail}");
            assert!(commit.candidates.is_empty());
        }
        store.commit(&commit);
    }
    let control = &store.walks[&WalkId(1)];
    assert_eq!((control.state.as_str(), control.accepted), ("quota_reached", 1));
    assert!(matches!(selector.next_assignment(0), Scheduling::Done));
}

/// Its dynamics may have gone on beyond a frame before it was asked for.
#[test]
fn a_control_walk_that_missed_its_last_frame_ends() {
    let mut store = MemoryStore::default();
    let mut selector = with_control(&mut store, &[5, 12]);
    for (step, expected) in [(10, vec![]), (12, vec!["ended"])] {
        let assignment = next_assignment(&mut selector);
        assert_eq!((assignment.origin, assignment.last_step), (Origin::Control, step));
        let commit = decided(&mut selector, common::report(&assignment, Outcome::StepsDone, at(step)));
        assert_eq!(kinds(&commit), expected);
        assert!(commit.decisions.iter().all(|decision| decision.detail["end"] == "completed"));
    }
    assert!(selector.is_done());
}

#[test]
fn a_walk_that_collected_nothing_has_no_control() {
    let mut selector = with_control(&mut MemoryStore::default(), &[]);
    assert!(matches!(selector.next_assignment(0), Scheduling::Done));
}

#[test]
fn control_frames_do_not_use_up_the_budget_or_the_mixture() {
    let mut store = MemoryStore::default();
    drop(with_control(&mut store, &[5]));
    let limited =
        SelectorSettings { control: true, max_structures: Some(2), ..settings(CampaignMode::Reproducible) };
    let mut selector = restore(&limited, 2, store.snapshot());
    store.commit(&selector.start_walks());
    let (control, biased) = (next_assignment(&mut selector), next_assignment(&mut selector));
    assert_eq!(
        (control.origin, biased.origin),
        (Origin::Control, Origin::Biased),
        "side by side in one round"
    );
    let frame = offer(&selector, &control, 5, structure(100, SHORTEST), NEW);
    let candidate = offer(&selector, &biased, 5, structure(101, SHORTEST), NEW);
    assert!(selector.report(candidate).unwrap().is_none());
    let commit = decided(&mut selector, frame);
    assert_eq!(kinds(&commit), ["control", "ended", "accepted", "ended", "begun"]);
    assert_eq!(commit.decisions[1].mixture_version, 0);
    store.commit(&commit);
    // The second of two: if the control frame counted, there would be no room left for it.
    let again = restore(&limited, 2, store.snapshot());
    assert_eq!(again.mixture(), selector.mixture());
}

#[test]
fn a_mismatched_database_is_rejected() {
    let mut store = MemoryStore::default();
    store.commit(&restore(&settings(CampaignMode::Live), 2, SelectorSnapshot::default()).start_walks());
    let good = store.snapshot();
    let refused = |seeds: usize, change: &dyn Fn(&mut SelectorSnapshot)| {
        let mut snapshot = good.clone();
        change(&mut snapshot);
        let error = try_restore(&settings(CampaignMode::Live), seeds, None, snapshot).err();
        error.expect("refused").to_string()
    };
    assert!(try_restore(&settings(CampaignMode::Live), 2, None, good.clone()).is_ok());
    assert!(refused(1, &|_| ()).contains("walk 1 starts from seed structure 1, but there are only 1"));
    assert!(refused(2, &|s| drop(s.walks.remove(0))).contains("found walk 1 in place of walk 0"));
    assert!(refused(2, &|s| s.walks[1].selector_state.clear()).contains("state of walk 1 is damaged"));
    assert!(refused(2, &|s| s.values[0].1.push('x')).contains("not a number"));
    let component = |bytes| ComponentRecord { element: 0, slot: 9, bytes };
    assert!(refused(2, &|s| s.components.push(component(vec![1]))).contains("component 9 of element 0"));
    let bytes = common::mixture().component(0, 0).unwrap().to_bytes();
    assert!(refused(2, &|s| s.components.push(component(bytes.clone()))).contains("no component 9"));
}

#[test]
fn a_seed_structure_that_cannot_be_graded_is_named() {
    let mut seed = common::seed_structure(0);
    seed.structure.species[1] = "Cu".parse().unwrap();
    let found = Selector::restore(
        settings(CampaignMode::Live),
        common::CAMPAIGN,
        vec![seed],
        common::grader(),
        common::mixture(),
        None,
        SelectorSnapshot::default(),
    );
    let message = found.err().expect("refused").to_string();
    assert_eq!(message, "seed structure 'seed-0': atom 1 is Cu, which the model does not support");
}

#[test]
fn paused_walks_get_no_assignments_while_others_continue_in_live_mode() {
    let mut selector = restore(&settings(CampaignMode::Live), 3, SelectorSnapshot::default());
    let _ = selector.start_walks();
    selector.set_paused([WalkId(0), WalkId(2)].into());
    assert_eq!(next_assignment(&mut selector).walk, WalkId(1));
    assert!(matches!(selector.next_assignment(0), Scheduling::Wait) && !selector.is_done());
    selector.set_paused([WalkId(0)].into());
    assert_eq!(next_assignment(&mut selector).walk, WalkId(2));
    selector.set_paused([].into());
    assert_eq!(next_assignment(&mut selector).walk, WalkId(0));
}
