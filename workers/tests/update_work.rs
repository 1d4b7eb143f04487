//! The energy that an update of the mixture gives to a biased walk, and structures beyond the largest grade.

use std::sync::Arc;

use atoms::units::BOLTZMANN;
use calm::{Batch, CovarianceUpdate, Mixture};
use wire::messages::{Assignment, AssignmentReport, Outcome, Verdict, WalkEnd};
use wire::{Candidate, Origin};
use workers::settings::{GuardSettings, WalkSettings};
use workers::walk::advance;

use crate::walk::{assignment, context, mixture, model, run, seed_structure, settings, whole_walk};

/// Collects every 40 steps from the first biased one on.
fn eager() -> WalkSettings {
    let collection = toml::from_str("rule = 'maximum_grade'\nthreshold = 1e-9").unwrap();
    WalkSettings { collection, min_interval: 40, trace_interval: 1, remove_update_work: true, ..settings() }
}

fn under(settings: &WalkSettings, mixture: Arc<Mixture>, next: &Assignment) -> AssignmentReport<Candidate> {
    let context = context(settings.clone());
    advance(&context, next, mixture, || false, |_| {}).unwrap()
}

#[test]
fn the_work_of_an_update_is_taken_out_of_the_kinetic_energy() {
    let (settings, before) = (eager(), mixture());
    let mut next = assignment(seed_structure("vacancy"), 500);
    let first = run(&settings, &next);
    assert_eq!(first.progress.step, 21);
    (next.checkpoint, next.verdict) = (Some(first.checkpoint), Some(Verdict::Accepted));
    let second = run(&settings, &next);
    let Outcome::Candidate(candidate) = &second.outcome else { panic!("{:?}", second.outcome) };
    assert_eq!(second.progress.step, 61);
    next.checkpoint = Some(second.checkpoint);
    next.last_step = 61;

    let elements = model().element_indices(&candidate.structure.species).unwrap();
    let batch = Batch::new(&before, &elements, &candidate.features).unwrap();
    let temperature = |settings: &WalkSettings, mixture: &Arc<Mixture>| {
        under(settings, Arc::clone(mixture), &next).progress.temperature
    };
    assert_eq!(temperature(&settings, &before), second.progress.temperature, "without an update");
    for alpha in [0.002, 1.0] {
        let changed = batch.updated(CovarianceUpdate::Convex { alpha }).unwrap();
        let after = Arc::new(before.with_changes(&changed).unwrap());
        let sum = |gamma: &[f64]| gamma.iter().sum::<f64>();
        let lowered = sum(&candidate.gamma) - sum(&batch.gamma_under(&changed));
        let work = second.trace.last().unwrap().bias_scale * lowered;
        assert!(work > 0.0);
        let degrees = 3.0 * candidate.structure.len() as f64;
        let expected = second.progress.temperature - 2.0 * work / (degrees * BOLTZMANN);
        let found = temperature(&settings, &after);
        let expected = expected.max(0.5 * 600.0);
        assert!((found - expected).abs() < 1e-8 * expected, "α {alpha}: {found} K, expected {expected} K");
        let as_in_the_paper = WalkSettings { remove_update_work: false, ..settings.clone() };
        assert_eq!(temperature(&as_in_the_paper, &after), second.progress.temperature);
    }
}

/// The velocities after an update meet the force of the step before: their smaller power is that of the work.
#[test]
fn the_work_of_the_bias_goes_on_with_the_smaller_velocities() {
    let settings = WalkSettings { thermostat: md::ThermostatSettings::None {}, zbl: None, ..eager() };
    let mut next = assignment(seed_structure("slab-111"), 500);
    next.conditions = wire::WalkConditions {
        temperature: 50.0,
        tau: 1.0,
        cell: wire::CellConditions::Fixed,
        ..next.conditions
    };
    for _ in 0..2 {
        let report = run(&settings, &next);
        (next.checkpoint, next.verdict) = (Some(report.checkpoint), Some(Verdict::Accepted));
    }
    let report = run(&settings, &next);
    let Outcome::Candidate(candidate) = &report.outcome else { panic!("no candidate") };
    let mixture = mixture();
    let elements = model().element_indices(&candidate.structure.species).unwrap();
    let batch = Batch::new(&mixture, &elements, &candidate.features).unwrap();
    let changed = batch.updated(CovarianceUpdate::Convex { alpha: 1.0 }).unwrap();
    let after = Arc::new(mixture.with_changes(&changed).unwrap());
    (next.checkpoint, next.last_step) = (Some(report.checkpoint.clone()), candidate.id.step + 1);
    let point = under(&settings, after, &next).trace.pop().unwrap();
    let [earlier, before] = report.trace.last_chunk::<2>().unwrap();
    assert_eq!((point.step, before.step), (before.step + 1, earlier.step + 1));
    let factor = (point.temperature / before.temperature).sqrt();
    // What the bias gave before the update, at the rate of the last step, and what is left of it with the smaller velocities.
    let wrong = 0.5 * (before.bias_work - earlier.bias_work) * (1.0 - factor);
    let gained = point.conserved_energy.unwrap() - before.conserved_energy.unwrap();
    let missing = gained - (point.bias_work - before.bias_work);
    assert!(factor < 0.9, "{before:?} {point:?}");
    assert!(missing.abs() < 0.3 * wrong.abs(), "{missing} of {wrong}");
}

/// A walk with two candidates, and the mixture that takes in a third.
fn after_an_update(settings: &WalkSettings, before: &Arc<Mixture>) -> (Assignment, Arc<Mixture>) {
    let mut next = assignment(seed_structure("vacancy"), 500);
    for _ in 0..2 {
        let report = run(settings, &next);
        (next.checkpoint, next.verdict) = (Some(report.checkpoint), Some(Verdict::Accepted));
    }
    let report = run(settings, &next);
    let Outcome::Candidate(candidate) = report.outcome else { panic!("no candidate") };
    let elements = model().element_indices(&candidate.structure.species).unwrap();
    let changed = Batch::new(before, &elements, &candidate.features)
        .unwrap()
        .updated(CovarianceUpdate::Convex { alpha: 0.1 })
        .unwrap();
    let after = before.at_version(before.version() + 1).with_changes(&changed).unwrap();
    (next, Arc::new(after))
}

#[test]
fn traces_have_the_grade_under_the_original_mixture_too() {
    let settings = WalkSettings { trace_interval: 4, remove_update_work: false, ..eager() };
    let before = mixture();
    let (next, after) = after_an_update(&settings, &before);
    let control = assignment(next.seed_structure.clone(), 80);
    let control = Assignment { origin: Origin::Control, ..control };
    for steps in [Assignment { last_step: 80, ..next }, control] {
        let original = under(&settings, Arc::clone(&before), &steps).trace;
        let live = under(&settings, Arc::clone(&after), &steps).trace;
        assert!(original.len() > 2, "{}", original.len());
        assert!(original.iter().all(|point| point.gamma_max_original == point.gamma_max));
        // The first steps after the update, whose bias has hardly moved an atom.
        let (live, original) = (&live[0], &original[0]);
        let [found, expected] = [live.gamma_max_original, original.gamma_max].map(Option::unwrap);
        assert!((found / expected - 1.0).abs() < 0.02, "{live:?} {original:?}");
        assert!(live.gamma_max < Some(0.98 * expected), "{live:?} {original:?}");
    }
}

/// The work is taken out once, however the walk is interrupted.
#[test]
fn an_interruption_after_an_update_changes_nothing() {
    for bias_norm_interval in [1, 4] {
        let (settings, before) = (WalkSettings { bias_norm_interval, ..eager() }, mixture());
        let (mut next, after) = after_an_update(&settings, &before);
        next.last_step = 80;
        let whole = under(&settings, Arc::clone(&after), &next);
        let kept = WalkSettings { remove_update_work: false, ..settings.clone() };
        assert_ne!(under(&kept, Arc::clone(&after), &next).progress.temperature, whole.progress.temperature);
        for last_step in [61, 61, 70, 80] {
            next.last_step = last_step;
            next.checkpoint = Some(under(&settings, Arc::clone(&after), &next).checkpoint);
            // The verdict is that of the first assignment.
            next.verdict = None;
        }
        assert_eq!(next.checkpoint, Some(whole.checkpoint));
    }
}

#[test]
fn structures_beyond_the_largest_grade_are_rejected() {
    let guard = GuardSettings { max_grade: Some(1e-6), max_rollbacks: 0, ..settings().guard };
    let reports = whole_walk(&WalkSettings { guard, ..eager() }, assignment(seed_structure("vacancy"), 150));
    let last = reports.last().unwrap();
    assert!(
        matches!(&last.outcome, Outcome::Ended(WalkEnd::Trapped { guard }) if guard == "largest-grade"),
        "{:?}",
        last.outcome
    );
    assert_eq!(last.progress.rejected, 5);
}
