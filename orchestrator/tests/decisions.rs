//! Decisions on candidates: every reason to decline, mixture updates, limits, and the log.

use std::sync::Arc;

use atoms::{MinDistanceRule, Uniform};
use calm::UpdateRule;
use calm::grade::maximum;
use calm::rules::MaximumGradeUpdate;
use orchestrator::selector::{
    CampaignMode, Selector, SelectorError, SelectorSettings, SelectorSnapshot, TrainingFrames,
    UpdateProtocol, VERSION,
};
use store::records::{Commit, Fate};
use wire::CompletionCoefficients;
use wire::messages::{DeclineReason, Verdict, WalkEnd};

use crate::common;
use crate::common::{
    SHORTEST, begin, completes_up_to, decided, ended, features, gamma_max, kinds, mixture, next_assignment,
    offer, positive, restore, settings, structure, try_restore, value,
};

/// γ = 3 in the first component.
const NEW: [f64; 3] = [0.0, 3.0, 0.0];
/// γ = 1 in the first component.
const KNOWN: [f64; 3] = [0.0, 1.0, 0.0];

pub fn live() -> SelectorSettings {
    settings(CampaignMode::Live)
}

/// A walk's next candidate: the structure with this number and these features.
pub fn next_candidate(selector: &mut Selector, step: u64, number: u64, z: [f64; 3]) -> Commit {
    let assignment = next_assignment(selector);
    let report = offer(selector, &assignment, step, structure(number, SHORTEST), z);
    decided(selector, report)
}

#[test]
fn accepted_structures_are_covered_afterwards() {
    let mut selector = begin(&live(), 1);
    let commit = next_candidate(&mut selector, 5, 1, NEW);
    assert_eq!(kinds(&commit), ["accepted"]);
    let [candidate] = commit.candidates.as_slice() else { panic!("{commit:?}") };
    assert_eq!(
        (candidate.fate, candidate.seed_structure, candidate.keep_features),
        (Fate::Accepted, 0, true)
    );
    assert_eq!((commit.decisions[0].mixture_version, value(&commit, "mixture_version")), (1, "1"));
    assert_eq!(commit.decisions[0].candidate, Some(candidate.block.view().id()));
    // Both atoms belong to one component; the other is unchanged.
    assert_eq!(commit.components.iter().map(|c| (c.element, c.slot)).collect::<Vec<_>>(), [(0, 0)]);
    assert_eq!((commit.walks.len(), commit.walks[0].accepted, commit.walks[0].assignments), (1, 1, 1));
    assert!(gamma_max(selector.mixture(), NEW) < 1.25);
    assert!(
        gamma_max(selector.mixture(), NEW)
            < commit.decisions[0].detail["selector"]["gamma_max"].as_f64().unwrap()
    );

    let commit = next_candidate(&mut selector, 6, 2, NEW);
    assert_eq!(kinds(&commit), ["declined covered"]);
    assert_eq!(commit.candidates[0].fate, Fate::Declined(DeclineReason::Covered));
    assert_eq!((selector.mixture().version(), commit.components.len()), (1, 0));
}

/// Three grades are recorded: the walker's, the selector's at the decision, and that of the original mixture.
#[test]
fn each_candidate_has_three_grades() {
    let mut selector = begin(&live(), 2);
    let (first, second) = (next_assignment(&mut selector), next_assignment(&mut selector));
    // Both walkers have the original mixture; the second candidate arrives after the first has updated it.
    let reports = [
        offer(&selector, &first, 5, structure(1, SHORTEST), NEW),
        offer(&selector, &second, 5, structure(2, SHORTEST), [0.0, 0.0, 3.5]),
    ];
    let [first, second] = reports.map(|report| decided(&mut selector, report));
    for (commit, z) in [(&first, 3.0), (&second, 3.5)] {
        let (candidate, detail) = (&commit.candidates[0], &commit.decisions[0].detail);
        assert_eq!(candidate.block.view().mixture_version(), 0);
        assert_eq!(detail["walker"]["mixture_version"], 0);
        assert!((maximum(candidate.block.view().gamma) - z).abs() < 1e-5);
        assert!((maximum(&candidate.original.gamma) - z).abs() < 1e-5);
        assert!((detail["original"]["gamma_max"].as_f64().unwrap() - z).abs() < 1e-5);
        // The two atoms are bonded, so the average lies between their grades.
        assert!(candidate.original.gamma_nbr.iter().all(|gamma| 0.0 < *gamma && *gamma < z));
        assert_eq!(detail["walker"]["atoms_above_1"], 1);
        assert!(detail.get("raised_by").is_none(), "the threshold is not raised");
    }
    assert_eq!(second.decisions[0].detail["selector"]["mixture_version"], 1);
    let (seen, newest) =
        (maximum(second.candidates[0].block.view().gamma), maximum(&second.candidates[0].selector.gamma));
    assert!(
        newest > seen * 1.01,
        "the convex update shrinks the direction that it did not visit: {newest}, {seen}"
    );
}

/// The walk continues, and the log gives the reason.
#[test]
fn a_candidate_that_cannot_be_graded_is_left_out() {
    let mut selector = begin(&live(), 1);
    let commit = next_candidate(&mut selector, 5, 1, [0.0, f64::NAN, 0.0]);
    assert_eq!(kinds(&commit), ["left_out"]);
    let [decision] = commit.decisions.as_slice() else { panic!("{commit:?}") };
    assert_eq!((decision.detail["step"].as_u64(), decision.candidate), (Some(5), None));
    assert!(decision.detail["error"].as_str().unwrap().contains("features are not finite"), "{decision:?}");
    assert_eq!((commit.candidates.len(), commit.components.len(), value(&commit, "left_out")), (0, 0, "1"));

    let assignment = next_assignment(&mut selector);
    assert_eq!(assignment.verdict, Some(Verdict::Declined(DeclineReason::LeftOut)));
    let report = offer(&selector, &assignment, 6, structure(2, SHORTEST), NEW);
    assert_eq!(kinds(&decided(&mut selector, report)), ["accepted"]);
}

/// It is an error of the campaign, whatever the candidate.
#[test]
fn an_error_that_is_not_of_the_candidate_is_returned() {
    let mut selector = begin(&live(), 1);
    let assignment = next_assignment(&mut selector);
    let report = offer(&selector, &assignment, 5, structure(1, SHORTEST), NEW);
    let failed = report.map_candidate(|_| Err(SelectorError::Snapshot("damaged".to_owned())));
    let error = selector.report_regraded(failed).unwrap_err();
    assert!(matches!(error, SelectorError::Snapshot(_)), "{error}");
}

/// Databases of campaigns with neither are as in earlier versions of the program.
#[test]
fn what_never_happened_is_not_stored() {
    let mut selector = restore(&live(), 1, SelectorSnapshot::default());
    let begun = selector.start_walks();
    let offered = next_candidate(&mut selector, 5, 1, NEW);
    for commit in [begun, offered] {
        let names: Vec<_> = commit.values.iter().map(|(name, _)| name.as_str()).collect();
        assert!(names.contains(&"round"), "{names:?}");
        assert!(![VERSION, "left_out"].iter().any(|name| names.contains(name)), "{names:?}");
    }
}

/// The covariance shrinks in the direction of the training atom, whose σ² is then no longer finite.
#[test]
fn an_update_under_which_a_training_atom_has_no_grade_is_left_out() {
    let training = TrainingFrames::new(&[0], &[0.0, 0.0, 1.3e154], &mixture()).unwrap();
    let mut selector = try_restore(&live(), 1, Some(training), SelectorSnapshot::default()).unwrap();
    selector.start_walks();
    let commit = next_candidate(&mut selector, 5, 1, NEW);
    assert_eq!(kinds(&commit), ["left_out"]);
    let error = commit.decisions[0].detail["error"].as_str().unwrap();
    assert!(error.starts_with("grading the training frames under the live mixture: σ² of atom 0"), "{error}");
    assert_eq!((commit.candidates.len(), commit.components.len(), value(&commit, "left_out")), (0, 0, "1"));
    assert_eq!(selector.mixture().as_ref(), mixture().as_ref());
    assert_eq!(selector.forgetting_level(), 0.0);

    let assignment = next_assignment(&mut selector);
    assert_eq!(assignment.verdict, Some(Verdict::Declined(DeclineReason::LeftOut)));
    let report = offer(&selector, &assignment, 6, structure(2, SHORTEST), [0.0, 0.0, 3.0]);
    assert_eq!(kinds(&decided(&mut selector, report)), ["accepted"]);
    assert_eq!(selector.mixture().version(), 1);
}

/// The second walk ends once the first has reached the limit of their seed structure, and continues with a larger limit.
#[test]
fn walks_of_one_seed_structure_share_a_limit() {
    let limited = SelectorSettings {
        update: UpdateProtocol::Never,
        max_per_walk: 3,
        max_per_seed_structure: Some(2),
        ..live()
    };
    let mut seed = common::seed_structure(0);
    seed.walks = vec![seed.walks[0].clone(); 2];
    let start = |settings: &SelectorSettings, snapshot| {
        let (grader, original) = (common::grader(), mixture());
        let seeds = vec![seed.clone()];
        Selector::restore(settings.clone(), common::CAMPAIGN, seeds, grader, original, None, snapshot)
            .unwrap()
    };
    let mut selector = start(&limited, SelectorSnapshot::default());
    let mut store = common::memory::MemoryStore::default();
    store.commit(&selector.start_walks());
    for (number, expected) in [(1, vec!["accepted"]), (2, vec!["accepted", "ended", "ended"])] {
        let commit = next_candidate(&mut selector, number, number, NEW);
        assert_eq!(kinds(&commit), expected);
        store.commit(&commit);
    }
    assert!(selector.is_done());
    let more = SelectorSettings { max_per_seed_structure: Some(4), ..limited };
    let mut selector = start(&more, store.snapshot());
    let resumed = kinds(&selector.start_walks());
    assert_eq!(resumed.iter().filter(|kind| *kind == "resumed").count(), 2, "{resumed:?}");
}

#[test]
fn atoms_too_close_are_declined() {
    let mut selector = begin(&live(), 1);
    let least = 0.75 * SHORTEST;
    for (number, distance, kind) in [(1, least - 1e-6, "declined too_close"), (2, least + 1e-6, "accepted")] {
        let assignment = next_assignment(&mut selector);
        let report = offer(&selector, &assignment, number, structure(number, distance), NEW);
        assert_eq!(kinds(&decided(&mut selector, report)), [kind]);
    }
}

/// The guard's absolute minimum distance applies if the fraction of the seed structure's distance is smaller.
#[test]
fn the_minimum_distance_is_the_larger_of_two() {
    let min_distances = MinDistanceRule::Uniform(Uniform { min_distance: 2.5, fraction: 0.75 });
    check_limit_of_2_5(min_distances);
}

#[test]
fn pairs_of_elements_have_their_own_minimum_distances() {
    check_limit_of_2_5(serde_json::from_str(r#"{ "rule": "per_pair", "pairs": { "Al-Al": 2.5 } }"#).unwrap());
}

fn check_limit_of_2_5(min_distances: MinDistanceRule) {
    let mut selector = begin(&SelectorSettings { min_distances, ..live() }, 1);
    let assignment = next_assignment(&mut selector);
    let report = offer(&selector, &assignment, 1, structure(1, 2.45), NEW);
    assert_eq!(kinds(&decided(&mut selector, report)), ["declined too_close"]);
}

#[test]
fn a_known_structure_is_declined() {
    let never = SelectorSettings { update: UpdateProtocol::Never, ..live() };
    let mut selector = begin(&never, 2);
    assert_eq!(kinds(&next_candidate(&mut selector, 5, 1, NEW)), ["accepted"]);
    let commit = next_candidate(&mut selector, 6, 1, NEW);
    assert_eq!(kinds(&commit), ["declined duplicate"]);
    assert_eq!(value(&commit, "mixture_version"), "0");
    // Imported structures are known from the start.
    let known = vec![wire::ContentHash::from_structure(&structure(7, SHORTEST))];
    let mut selector = common::restore(&never, 1, SelectorSnapshot { known, ..SelectorSnapshot::default() });
    selector.start_walks();
    assert_eq!(kinds(&next_candidate(&mut selector, 5, 7, NEW)), ["declined duplicate"]);
}

#[test]
fn without_updates_everything_new_to_the_original_mixture_is_accepted() {
    let mut selector = begin(&SelectorSettings { update: UpdateProtocol::Never, ..live() }, 1);
    for number in 1..=2 {
        let commit = next_candidate(&mut selector, number, number, NEW);
        assert_eq!(kinds(&commit), ["accepted"]);
        assert!(commit.components.is_empty() && commit.decisions[0].detail.get("update").is_none());
    }
    assert_eq!(selector.mixture().as_ref(), mixture().as_ref());
}

#[test]
fn the_limit_per_seed_structure_is_enforced() {
    let mut selector =
        begin(&SelectorSettings { update: UpdateProtocol::Never, max_per_walk: 2, ..live() }, 2);
    assert_eq!(kinds(&next_candidate(&mut selector, 5, 1, NEW)), ["accepted"]);
    let commit = next_candidate(&mut selector, 6, 2, NEW);
    assert_eq!(kinds(&commit), ["accepted", "ended"]);
    assert_eq!((commit.walks[0].state.as_str(), commit.walks[0].accepted), ("quota_reached", 2));
    assert_eq!(next_assignment(&mut selector).walk.0, 1);
}

/// The limit may be lowered while a walk is running.
#[test]
fn a_walk_beyond_its_budget_ends_with_its_next_candidate() {
    let mut store = common::memory::MemoryStore::default();
    let more = SelectorSettings { update: UpdateProtocol::Never, max_per_walk: 3, ..live() };
    let mut selector = common::restore(&more, 1, SelectorSnapshot::default());
    store.commit(&selector.start_walks());
    for number in 1..=2 {
        store.commit(&next_candidate(&mut selector, number, number, NEW));
    }
    let mut selector = common::restore(&SelectorSettings { max_per_walk: 2, ..more }, 1, store.snapshot());
    let commit = next_candidate(&mut selector, 3, 3, NEW);
    assert_eq!(kinds(&commit), ["declined budget", "ended"]);
    assert!(selector.is_done());
}

#[test]
fn the_campaign_limit_is_enforced() {
    let limited = SelectorSettings { update: UpdateProtocol::Never, max_structures: Some(2), ..live() };
    let mut selector = begin(&limited, 3);
    let assignments = [(); 3].map(|()| next_assignment(&mut selector));
    let kinds: Vec<_> = (1..)
        .zip(&assignments)
        .flat_map(|(number, assignment)| {
            let report = offer(&selector, assignment, 5, structure(number, SHORTEST), NEW);
            kinds(&decided(&mut selector, report))
        })
        .collect();
    // The last accept ends the unassigned walks; an assigned walk ends with its report.
    assert_eq!(kinds, ["accepted", "accepted", "ended", "ended", "declined budget", "ended"]);
    assert!(selector.is_done());
}

#[test]
fn imports_are_logged_once_when_they_begin_to_count() {
    let snapshot = |values| SelectorSnapshot { imported: 3, values, ..SelectorSnapshot::default() };
    let mut selector = common::restore(&live(), 1, snapshot(Vec::new()));
    let commit = selector.start_walks();
    assert_eq!(kinds(&commit), ["imported", "begun"]);
    assert_eq!(
        (commit.decisions[0].walk, &commit.decisions[0].detail["structures"]),
        (None, &serde_json::json!(3))
    );
    let mut again = common::restore(
        &live(),
        1,
        SelectorSnapshot { walks: commit.walks.clone(), ..snapshot(commit.values) },
    );
    assert!(again.start_walks().decisions.is_empty());
}

#[test]
fn walks_that_ended_by_a_limit_resume_when_it_is_raised() {
    // No control walk is due.
    let limited = SelectorSettings {
        update: UpdateProtocol::Never,
        max_structures: Some(1),
        control: true,
        control_share: 0.1,
        ..live()
    };
    let mut selector = common::restore(&limited, 2, SelectorSnapshot::default());
    let mut walks = std::collections::BTreeMap::new();
    let mut keep = |commit: &Commit| walks.extend(commit.walks.iter().map(|walk| (walk.walk, walk.clone())));
    let begun = selector.start_walks();
    keep(&begun);
    let commit = next_candidate(&mut selector, 5, 1, NEW);
    assert_eq!(kinds(&commit), ["accepted", "ended", "ended", "begun"]);
    keep(&commit);
    let walks = walks.values().cloned().collect();
    let stored = SelectorSnapshot { walks, values: begun.values, ..SelectorSnapshot::default() };
    // With the same limit only the control walk continues.
    let mut same = common::restore(&limited, 2, stored.clone());
    assert!(same.start_walks().decisions.is_empty());
    assert_eq!(next_assignment(&mut same).walk, wire::WalkId(2));
    // With a larger limit both walks continue from where they ended, and only new structures get another control walk.
    let mut larger = common::restore(&SelectorSettings { max_structures: Some(2), ..limited }, 2, stored);
    assert_eq!(kinds(&larger.start_walks()), ["configuration", "resumed", "resumed"]);
    let assignment = next_assignment(&mut larger);
    assert_eq!((assignment.number, assignment.verdict.clone()), (1, Some(Verdict::Accepted)));
    let report = offer(&larger, &assignment, 9, structure(2, SHORTEST), NEW);
    let commit = decided(&mut larger, report);
    assert_eq!(kinds(&commit), ["accepted", "ended", "ended", "begun"]);
    assert_eq!(commit.decisions[3].detail["wanted"], serde_json::json!([9]));
}

#[test]
fn the_first_reason_applies() {
    let limited = SelectorSettings { max_per_walk: 1, max_structures: Some(1), ..live() };
    let known = vec![
        wire::ContentHash::from_structure(&structure(1, 1.0)),
        wire::ContentHash::from_structure(&structure(2, SHORTEST)),
    ];
    let mut selector =
        common::restore(&limited, 4, SelectorSnapshot { known, ..SelectorSnapshot::default() });
    selector.start_walks();
    let [first, assignments @ ..] = [(); 4].map(|()| next_assignment(&mut selector));
    let report = offer(&selector, &first, 1, structure(9, SHORTEST), NEW);
    assert_eq!(kinds(&decided(&mut selector, report)), ["accepted", "ended"]);
    // Close and known; known and covered; covered and beyond the limit.
    let offers =
        [(structure(1, 1.0), KNOWN), (structure(2, SHORTEST), KNOWN), (structure(3, SHORTEST), KNOWN)];
    let reasons = assignments.iter().zip(offers).flat_map(|(assignment, (structure, z))| {
        let report = offer(&selector, assignment, 1, structure, z);
        kinds(&decided(&mut selector, report))
    });
    let reasons: Vec<_> = reasons.filter(|kind| kind != "ended").collect();
    assert_eq!(reasons, ["declined too_close", "declined duplicate", "declined budget"]);
}

#[test]
fn the_verdict_is_part_of_the_next_assignment() {
    let mut selector = begin(&live(), 1);
    assert_eq!(next_assignment(&mut selector).verdict, None);
    selector.assignment_lost(wire::WalkId(0));
    next_candidate(&mut selector, 4, 1, NEW);
    let assignment = next_assignment(&mut selector);
    assert_eq!(
        (assignment.verdict.clone(), assignment.number, assignment.last_step),
        (Some(Verdict::Accepted), 1, 14)
    );
    assert_eq!(assignment.checkpoint.as_deref(), Some(b"step 4".as_slice()));
    let report = offer(&selector, &assignment, 9, structure(2, SHORTEST), NEW);
    decided(&mut selector, report);
    let assignment = next_assignment(&mut selector);
    assert_eq!(assignment.verdict, Some(Verdict::Declined(DeclineReason::Covered)));
    // Interrupted: the checkpoint already accounts for the verdict, which is not sent again.
    let paused = common::report(&assignment, wire::messages::Outcome::Interrupted, common::at(11));
    let commit = decided(&mut selector, paused);
    assert!(commit.decisions.is_empty() && commit.values.is_empty());
    let again = next_assignment(&mut selector);
    assert_eq!(
        (again.verdict, again.number, again.last_step),
        (None, assignment.number, assignment.last_step)
    );
    assert_eq!(again.checkpoint.as_deref(), Some(b"step 11".as_slice()));
}

#[test]
fn features_of_declined_candidates_are_limited() {
    let size = size_of_val(features(NEW).as_slice()) as u64;
    let limited = SelectorSettings { declined_feature_bytes: 2 * size + 1, ..live() };
    let mut store = common::memory::MemoryStore::default();
    let mut selector = common::restore(&limited, 1, SelectorSnapshot::default());
    store.commit(&selector.start_walks());
    for (number, keep, bytes) in [(1, true, size), (2, true, 2 * size), (3, false, 2 * size)] {
        // The limit is still reached after a restart.
        selector = common::restore(&limited, 1, store.snapshot());
        let commit = next_candidate(&mut selector, number, number, KNOWN);
        assert_eq!(kinds(&commit), ["declined covered"]);
        assert_eq!(commit.candidates[0].keep_features, keep);
        assert_eq!(value(&commit, "declined_feature_bytes"), bytes.to_string());
        store.commit(&commit);
    }
    let commit = next_candidate(&mut selector, 4, 4, NEW);
    assert!(commit.candidates[0].keep_features, "those of accepted ones are always kept");
}

#[test]
fn updates_accumulate_over_seed_structures() {
    let mut selector = begin(&settings(CampaignMode::Reproducible), 2);
    end_first_walk_after_a_collection(&mut selector);
    assert_eq!(selector.mixture().version(), 1);
    assert!(gamma_max(selector.mixture(), NEW) < 1.25);
}

#[test]
fn each_seed_structure_starts_from_the_original_mixture() {
    let restarted = SelectorSettings {
        update: UpdateProtocol::PerSeedStructure,
        walks_per_round: 1,
        ..settings(CampaignMode::Reproducible)
    };
    let training = TrainingFrames::new(&[0], &[0.0, 0.0, 0.9], &mixture()).unwrap();
    let mut selector = try_restore(&restarted, 2, Some(training), SelectorSnapshot::default()).unwrap();
    selector.start_walks();
    let commit = end_first_walk_after_a_collection(&mut selector);
    assert!(commit.restart_mixture && commit.components.is_empty());
    // Versions continue: no two mixtures share a number.
    assert_eq!((value(&commit, "mixture_version"), selector.mixture().version()), ("2", 2));
    assert_eq!(selector.mixture().at_version(0), *mixture());
    let watched: serde_json::Value = serde_json::from_str(value(&commit, "training_frames")).unwrap();
    assert!((watched["maximum"].as_f64().unwrap() - 0.9).abs() < 1e-5, "{watched}");
}

/// Accepts a candidate of the first walk, which then ends. Returns the last commit.
fn end_first_walk_after_a_collection(selector: &mut Selector) -> Commit {
    let mut reports = Vec::new();
    while let orchestrator::selector::Scheduling::Assign(assignment) = selector.next_assignment(0) {
        let number = u64::from(assignment.walk.0);
        let z = if number == 0 { NEW } else { KNOWN };
        reports.push(offer(selector, &assignment, 5, structure(number, SHORTEST), z));
    }
    let last = reports.into_iter().filter_map(|report| selector.report(report).unwrap()).last().unwrap();
    assert_eq!(kinds(&last)[0], "accepted");
    let mut reports = Vec::new();
    while let orchestrator::selector::Scheduling::Assign(assignment) = selector.next_assignment(0) {
        let done = wire::messages::Outcome::StepsDone;
        reports.push(match assignment.walk.0 {
            0 => ended(&assignment, 10, WalkEnd::Completed),
            _ => common::report(&assignment, done, common::at(10)),
        });
    }
    let last = reports.into_iter().filter_map(|report| selector.report(report).unwrap()).last().unwrap();
    assert_eq!(kinds(&last), ["ended"]);
    last
}

/// Candidates that are new, but below the threshold raised by a long queue, have their own reason to decline.
#[test]
fn candidates_below_a_raised_threshold_are_declined() {
    let mut selector = begin(&live(), 1);
    selector.raise_threshold_above(100);
    selector.set_unfinished_jobs(150);
    let commit = next_candidate(&mut selector, 5, 1, [0.0, 1.8, 0.0]);
    assert_eq!(kinds(&commit), ["declined backlog"]);
    let detail = &commit.decisions[0].detail;
    assert_eq!((&detail["raised_by"], &detail["threshold"]), (&1.25.into(), &1.875.into()));
    assert_eq!(kinds(&next_candidate(&mut selector, 6, 2, KNOWN)), ["declined covered"]);
    assert_eq!(kinds(&next_candidate(&mut selector, 7, 3, NEW)), ["accepted"]);
    selector.set_unfinished_jobs(100);
    assert_eq!(next_assignment(&mut selector).threshold_factor, 1.0);
    assert_eq!((selector.max_unfinished_jobs(100), begin(&live(), 1).max_unfinished_jobs(100)), (200, 100));
}

/// The model sees the grade under the original mixture, which updates do not change.
#[test]
fn candidates_whose_labels_would_probably_fail_are_declined() {
    let mut selector = begin(&SelectorSettings { max_per_walk: 9, ..live() }, 1);
    selector.set_completion_model(completes_up_to(0.1));
    assert_eq!(
        kinds(&next_candidate(&mut selector, 5, 1, NEW)),
        ["accepted"],
        "the campaign does not ask for it"
    );
    selector.decline_unlikely(0.5);
    let far = [0.0, 0.0, 9.0];
    let unknown = next_candidate(&mut selector, 6, 2, [0.0, 0.0, 4.0]);
    assert_eq!(
        (kinds(&unknown), unknown.decisions[0].detail.get("completion")),
        (vec!["accepted".to_owned()], None)
    );
    // A share that is the same for all candidates declines none.
    selector.set_completion_model(CompletionCoefficients::constant(0.1));
    assert_eq!(kinds(&next_candidate(&mut selector, 7, 6, [0.0, -7.0, 0.0])), ["accepted"]);
    selector.set_completion_model(completes_up_to(6.0));
    let commit = next_candidate(&mut selector, 8, 3, far);
    assert_eq!(kinds(&commit), ["declined unlikely_to_complete"]);
    let completion = &commit.decisions[0].detail["completion"];
    assert_eq!((&completion["probability"], &completion["min_probability"]), (&0.4.into(), &0.5.into()));
    assert_eq!(
        (commit.components.len(), commit.candidates[0].fate),
        (0, Fate::Declined(DeclineReason::UnlikelyToComplete))
    );
    // Other reasons come first.
    assert_eq!(kinds(&next_candidate(&mut selector, 9, 4, KNOWN)), ["declined covered"]);
    selector.set_completion_model(completes_up_to(10.0));
    assert_eq!(kinds(&next_candidate(&mut selector, 10, 5, far)), ["accepted"]);
}

/// The walker tests the grade under its own mixture, which sinks with updates; that under the original one does not.
#[test]
fn candidates_beyond_the_largest_grade_under_the_original_mixture_are_declined() {
    let mut selector = begin(&SelectorSettings { max_per_walk: 9, max_grade: Some(4.0), ..live() }, 1);
    assert_eq!(kinds(&next_candidate(&mut selector, 5, 1, [0.0, 3.0, 0.0])), ["accepted"]);
    let commit = next_candidate(&mut selector, 6, 2, [0.0, 4.5, 0.0]);
    assert_eq!(kinds(&commit), ["declined grade_too_large"]);
    let detail = &commit.decisions[0].detail;
    let grade = |mixture: &str| detail[mixture]["gamma_max"].as_f64().unwrap();
    assert!(grade("selector") < 4.0 && grade("original") > 4.0, "{detail}");
    assert_eq!((commit.components.len(), commit.walks[0].accepted), (0, 1));
    // The bound itself is allowed.
    let bound = maximum(&commit.candidates[0].original.gamma);
    for (max_grade, kind) in [(bound, "accepted"), (bound.next_down(), "declined grade_too_large")] {
        let mut selector = begin(&SelectorSettings { max_grade: Some(max_grade), ..live() }, 1);
        assert_eq!(kinds(&next_candidate(&mut selector, 5, 1, [0.0, 4.5, 0.0])), [kind]);
    }
}

/// The rule of updates is used in the search, not only the collection rule.
#[test]
fn the_update_target_comes_from_the_settings() {
    let mut strict = live();
    strict.search.stop = UpdateRule::MaximumGrade(MaximumGradeUpdate { target: positive(0.8) });
    let mut selector = begin(&strict, 1);
    let commit = next_candidate(&mut selector, 5, 1, NEW);
    let after = commit.decisions[0].detail["update"]["gamma_max_after"].as_f64().unwrap();
    assert!(after < 0.8 && (after - gamma_max(selector.mixture(), NEW)).abs() < 1e-12);
    assert!(!Arc::ptr_eq(selector.mixture(), &mixture()));
}
