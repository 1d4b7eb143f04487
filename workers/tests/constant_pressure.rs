//! Walks at constant pressure: the reference run, the bias on the cell, and how such walks end.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use atoms::{Matrix3, Structure};
use md::{BarostatSettings, Dynamics, DynamicsSettings, State, Stream};
use potentials::grace::Grace;
use wire::messages::{Assignment, AssignmentReport, Outcome, WalkEnd};
use wire::{Candidate, CellConditions, ConstantPressure, Origin, WalkConditions};
use workers::bias::BiasedPotential;
use workers::cell_bias::CellBiasSettings;
use workers::settings::WalkSettings;
use workers::walk::advance;

use crate::walk::{assignment, context, mixture, model, never, run, seed_structure, settings, whole_walk};

const REFERENCE_STEPS: u64 = 60;

fn at_constant_pressure() -> WalkSettings {
    let barostat = BarostatSettings { relaxation_time: 100.0, ..Default::default() };
    WalkSettings { reference_steps: REFERENCE_STEPS, barostat, collection: never(), ..settings() }
}

fn conditions(start_volume: f64, cell_bias: bool) -> WalkConditions {
    at_pressure(ConstantPressure { pressure: 1.0, start_volume, cell_bias })
}

fn at_pressure(constant: ConstantPressure) -> WalkConditions {
    let cell = CellConditions::ConstantPressure(constant);
    WalkConditions { temperature: 600.0, tau: 0.15, cell, ..WalkConditions::default() }
}

fn from(conditions: WalkConditions, until: u64) -> Assignment {
    Assignment { conditions, ..assignment(seed_structure("vacancy"), until) }
}

/// A structure of the control walk.
fn frame(settings: &WalkSettings, conditions: WalkConditions, step: u64) -> Candidate {
    let control =
        Assignment { origin: Origin::Control, frame_steps: vec![step], ..from(conditions, u64::MAX) };
    let Outcome::Candidate(frame) = run(settings, &control).outcome else { panic!("no frame") };
    frame
}

/// V₀ is the mean volume over the second half of a run with other random numbers, and the walk starts from its last structure.
#[test]
fn a_walk_starts_from_the_end_of_its_reference_run() {
    let settings = at_constant_pressure();
    let seed = seed_structure("vacancy");
    let [dense, dilute] = [0.94, 1.06].map(|volume| frame(&settings, conditions(volume, false), 1));
    let reference = dense.structure.cell.volume() / 0.94;
    assert!((dilute.structure.cell.volume() / 1.06 / reference - 1.0).abs() < 1e-12, "the same V₀");
    assert!((reference / seed.cell.volume() - 1.0).abs() > 1e-4, "not that of the seed structure");
    assert!((dense.relative_volume - 0.94).abs() < 1e-12);
    // The same run by itself.
    let content = wire::ContentHash::from_structure(&seed).0;
    let stream =
        Stream::new(settings.rng_seed, u32::from_le_bytes(content[..4].try_into().unwrap()), u32::MAX);
    let (mut dynamics, mut potential) = run_of(seed, &settings, stream);
    let volumes = (0..REFERENCE_STEPS).map(|_| {
        dynamics.step(&mut potential).unwrap();
        dynamics.structure().cell.volume()
    });
    let volumes: Vec<f64> = volumes.skip(REFERENCE_STEPS as usize / 2).collect();
    let mean = volumes.iter().sum::<f64>() / volumes.len() as f64;
    assert!((mean / reference - 1.0).abs() < 1e-12, "{mean} is not {reference}");
}

/// Dynamics with barostat and bias of these settings, the bias off.
fn run_of(structure: Structure, settings: &WalkSettings, stream: Stream) -> (Dynamics, BiasedPotential) {
    let zbl = settings.zbl.as_ref().map(|windows| potentials::Zbl::new(&structure.species, windows).unwrap());
    let grace = Box::new(Grace::new(model()));
    let mut potential = BiasedPotential::new(grace, mixture(), zbl, 10, &structure.species).unwrap();
    let thermostat = settings.thermostat.start(600.0);
    let barostat = settings.barostat.start(600.0, &thermostat, &structure);
    let state = State::thermal(structure, 600.0, &stream);
    let run =
        DynamicsSettings { time_step: 2.0, thermostat, cell_motion: barostat.into(), stream, skin: 0.5 };
    (Dynamics::new(state, run, &mut potential).unwrap(), potential)
}

#[test]
fn a_reference_run_and_a_biased_cell_continue_from_any_step() {
    let settings = WalkSettings { cell_bias: quick(), ..at_constant_pressure() };
    let whole = run(&settings, &from(conditions(1.02, true), 90));
    assert_eq!((&whole.outcome, whole.progress.step), (&Outcome::StepsDone, 90));
    let context = context(settings.clone());
    // Interrupted twice in the reference run, of which an assignment makes as many steps as it would make of the walk.
    let undisturbed = run(&settings, &from(conditions(1.02, true), 40));
    assert_eq!((&undisturbed.outcome, undisturbed.progress.step), (&Outcome::StepsDone, 0));
    let mut next = from(conditions(1.02, true), 40);
    for steps in [7, 31] {
        let asked = AtomicU64::new(0);
        let stopping = || asked.fetch_add(1, Ordering::Relaxed) == steps;
        let report = advance(&context, &next, mixture(), stopping, |_| {}).unwrap();
        assert_eq!((&report.outcome, report.progress.step), (&Outcome::Interrupted, 0));
        next.checkpoint = Some(report.checkpoint);
    }
    let report = run(&settings, &next);
    assert_eq!((&report.outcome, report.progress.step), (&Outcome::StepsDone, 0));
    assert_eq!(report.checkpoint, undisturbed.checkpoint, "interruptions are no steps");
    next.checkpoint = Some(report.checkpoint);
    for last_step in [5, 20, 21, 33, 90] {
        next.number += 1;
        next.last_step = last_step;
        let report = run(&settings, &next);
        let expected = if last_step == 5 { 0 } else { last_step };
        assert_eq!((&report.outcome, report.progress.step), (&Outcome::StepsDone, expected));
        next.checkpoint = Some(report.checkpoint);
    }
    assert_eq!(next.checkpoint, Some(whole.checkpoint));
}

/// A bias on the cell that is adjusted every 20 steps.
fn quick() -> CellBiasSettings {
    CellBiasSettings { window: 20, ..CellBiasSettings::default() }
}

/// τ = 0 switches the bias on the cell off too.
#[test]
fn a_control_walk_is_the_unbiased_walk() {
    let settings = WalkSettings { cell_bias: quick(), ..at_constant_pressure() };
    let [biased, unbiased] = [true, false].map(|bias| frame(&settings, conditions(1.03, bias), 70));
    assert_eq!(biased.structure, unbiased.structure);
    assert_eq!(biased.forces, unbiased.forces);
    // And a biased walk is another one.
    let settings = WalkSettings { cell_bias: CellBiasSettings { gain: 0.1, ..quick() }, ..settings };
    let walk = |bias| run(&settings, &from(conditions(1.0, bias), 150)).progress.relative_volume;
    assert_ne!(walk(true), walk(false));
}

/// Without a bias, a walk is what the dynamics of the model give without any of the walk's code: bit for bit.
#[test]
fn a_control_walk_is_plain_dynamics_of_the_model() {
    let settings =
        WalkSettings { reference_steps: 0, zbl: None, cell_bias: quick(), ..at_constant_pressure() };
    let found = frame(&settings, conditions(1.03, true), 150);
    let model = model();
    let mut grace = Grace::new(Arc::clone(&model));
    let stream = Stream::new(settings.rng_seed, 0, 0);
    let mut state = State::thermal(seed_structure("vacancy"), 600.0, &stream);
    let volume = md::extent(&state.structure);
    md::scale_volume(&mut state.structure, 1.03 * volume / volume);
    let thermostat = settings.thermostat.start(600.0);
    let run = DynamicsSettings {
        time_step: 2.0,
        thermostat: thermostat.clone(),
        cell_motion: md::CellMotion::Fixed,
        stream,
        skin: settings.skin,
    };
    let mut dynamics = Dynamics::new(state, run, &mut grace).unwrap();
    (0..settings.equilibration_steps).for_each(|_| dynamics.step(&mut grace).unwrap());
    let barostat = settings.barostat.start(600.0, &thermostat, dynamics.structure());
    dynamics.set_cell_motion(barostat.into()).unwrap();
    (settings.equilibration_steps..150).for_each(|_| dynamics.step(&mut grace).unwrap());
    assert!((dynamics.structure().cell.volume() / volume - 1.03).abs() > 1e-3, "the cell moves");
    assert_eq!(found.structure, *dynamics.structure());
    assert_eq!(found.forces, dynamics.evaluation().forces);
    assert_eq!(found.temperature, dynamics.temperature());
}

/// The stress does work on the cell, which goes where grades are larger.
#[test]
fn the_bias_on_the_cell_works_along_the_derivative_of_the_grades() {
    let settings = at_constant_pressure();
    let start = || run_of(seed_structure("vacancy"), &settings, Stream::new(1, 0, 0));
    let mean_sum = |tau: f64, stress: f64| {
        let (mut dynamics, mut potential) = start();
        let (mut sum, mut along) = (0.0, 0.0);
        for step in 0..400 {
            potential.tau = tau;
            let before = potential.state.strain_direction;
            let cell = dynamics.structure().cell;
            dynamics.step_with_bias_stress(&mut potential, |bias, _| bias.cell_stress(stress)).unwrap();
            along += contraction(&before, &strain(&cell.0, &dynamics.structure().cell.0));
            let grades = potential.grades(dynamics.structure(), dynamics.neighbours()).unwrap();
            sum += if step < 200 { 0.0 } else { grades.gamma.iter().sum::<f64>() / 200.0 };
        }
        (sum, along, dynamics.barostat().unwrap().work)
    };
    // A bias on the forces alone would do so too: it is too small to matter here.
    let (without, _, no_work) = mean_sum(1e-9, 0.0);
    let (with, along, work) = mean_sum(1e-9, 0.02);
    assert_eq!(no_work, 0.0);
    assert!(along > 0.0 && work > 0.0, "{along} along the derivative, {work} eV");
    assert!(with > 1.02 * without, "Σγ {with} with, {without} without");
}

fn contraction(a: &Matrix3, b: &Matrix3) -> f64 {
    a.as_flattened().iter().zip(b.as_flattened()).map(|(a, b)| a * b).sum()
}

/// ε of h′ = h (1 + ε).
fn strain(before: &Matrix3, after: &Matrix3) -> Matrix3 {
    let inverse = atoms::Cell(*before).reciprocal();
    let mut strain = Matrix3::default();
    for (row, k) in strain.iter_mut().zip(0..3) {
        for (element, l) in row.iter_mut().zip(0..3) {
            // Columns of the inverse are the reciprocal vectors.
            *element = (0..3).map(|m| inverse[m][k] * (after[m][l] - before[m][l])).sum();
        }
    }
    strain
}

#[test]
fn a_walk_ends_at_a_boundary_of_its_volume() {
    let cell_bias = CellBiasSettings {
        gain: 0.1,
        volume_range: [0.98, 1.02],
        window: 200,
        collected_to_end: 0,
        ..CellBiasSettings::default()
    };
    let settings = WalkSettings { cell_bias, ..at_constant_pressure() };
    let reports = whole_walk(&settings, from(conditions(1.0, true), 150));
    let AssignmentReport { outcome, progress, .. } = reports.last().unwrap();
    assert_eq!(*outcome, Outcome::Ended(WalkEnd::VolumeBoundary), "after {} steps", progress.step);
    assert!(progress.step > 20 && (0.98 - 1e-9..1.02 + 1e-9).contains(&progress.relative_volume));
}

#[test]
fn a_pressure_that_tears_the_cell_apart_ends_the_walk() {
    let pulled = ConstantPressure { pressure: -1e6, start_volume: 1.0, cell_bias: false };
    let torn = from(at_pressure(pulled), 400);
    let settings = WalkSettings { reference_steps: 0, ..at_constant_pressure() };
    let outcome = run(&settings, &torn).outcome;
    let Outcome::Ended(WalkEnd::Diverged { reason }) = outcome else { panic!("{outcome:?}") };
    assert!(reason.contains("the volume is") || reason.contains("the cell changes by"), "{reason}");
}

#[test]
fn a_structure_without_a_bulk_modulus_is_no_start_for_a_biased_cell() {
    let mut loose = from(conditions(1.0, true), 10);
    md::scale_volume(&mut loose.seed_structure, 2.2);
    let outcome = run(&at_constant_pressure(), &loose).outcome;
    let Outcome::Ended(WalkEnd::InvalidStart { reason }) = outcome else { panic!("{outcome:?}") };
    assert!(reason.contains("walk.cell_bias.stress_scale"), "{reason}");
}
