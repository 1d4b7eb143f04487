//! Walks that measure the norms of τ_r in every n-th biased step only, and have one gradient for forces and bias in those between.

use std::sync::Arc;

use atoms::{Evaluation, NeighbourList, Potential, Structure, Vec3, cell};
use md::ThermostatSettings;
use potentials::grace::{Grace, Threads};
use wire::messages::{Assignment, Outcome};
use wire::{CellConditions, ConstantPressure, TracePoint, WalkConditions};
use workers::bias::BiasedPotential;
use workers::settings::WalkSettings;
use workers::walk::{WalkContext, advance_observed};

use crate::walk::{assignment, conditions, mixture, model, never, reference, run, seed_structure, settings};

const NVE: ThermostatSettings = ThermostatSettings::None {};

fn norms(vectors: &[Vec3]) -> f64 {
    vectors.iter().map(|v| cell::norm(*v)).sum()
}

/// Each evaluation is F + τ_r ∇Σγ to rounding, with the norms of the last measured one, and the potential alone is known after a separation.
#[test]
fn the_bias_has_the_norms_that_were_measured_last() {
    let (model, mixture, structure) = (model(), mixture(), seed_structure("slab-111"));
    let grace = Box::new(Grace::new(Arc::clone(&model)));
    let mut biased = BiasedPotential::new(grace, Arc::clone(&mixture), None, 4, &structure.species).unwrap();
    (biased.tau, biased.norm_interval) = (0.3, 3);
    let mut neighbours = NeighbourList::new(model.cutoff(), 0.0);
    let (mut force_norm, mut gradient_norm, mut measured) = (0.0, 0.0, Vec::new());
    for call in 0_i32..15 {
        let mut moved = structure.clone();
        let shift = |r: &mut Vec3, k: usize| r[k % 3] += 0.02 * ((7 * k + 3 * call as usize) as f64).sin();
        moved.positions.iter_mut().enumerate().for_each(|(k, r)| shift(r, k));
        neighbours.update(&moved).unwrap();
        let mut out = Evaluation::default();
        biased.evaluate(&moved, &neighbours, &mut out).unwrap();
        let (physical, gradient) = reference(&model, &mixture, &moved, &neighbours);
        // Four that settle, the first with a bias, and the last of every three with a bias.
        let elapsed = match call {
            ..=4 => Some(1),
            6 => Some(2),
            _ => (call % 3 == 0).then_some(3),
        };
        assert_eq!(biased.measured_after(), elapsed.map(|elapsed| elapsed as u64), "{call}");
        if let Some(elapsed) = elapsed {
            let weight = if call == 0 { 1.0 } else { 1.0 - 0.75_f64.powi(elapsed) };
            force_norm += weight * (norms(&physical.forces) - force_norm);
            gradient_norm += weight * (norms(&gradient.gradient) - gradient_norm);
            measured.push(call);
        }
        let scale = if call < 4 { 0.0 } else { 0.3 * force_norm / gradient_norm };
        assert!((biased.bias_scale() - scale).abs() <= 1e-12 * scale, "{call}");
        for (found, (force, gradient)) in
            out.forces.iter().zip(physical.forces.iter().zip(&gradient.gradient))
        {
            let expected = cell::add(*force, cell::scale(*gradient, scale));
            assert!(
                cell::norm(cell::sub(*found, expected)) <= 1e-10 * (1.0 + cell::norm(expected)),
                "{call}"
            );
        }
        assert_eq!(out.atomic_energies, physical.atomic_energies);
        let (state, gamma) = (biased.state, biased.grades(&moved, &neighbours).unwrap().gamma.clone());
        biased.separate(&moved, &neighbours).unwrap();
        assert_eq!(biased.physical(), &physical, "{call}");
        let share = scale * norms(&gradient.gradient) / norms(&physical.forces);
        assert!((biased.bias_share() - share).abs() <= 1e-9 * (1.0 + share), "{call}");
        for (k, (total, of_bias)) in
            out.virial.as_flattened().iter().zip(biased.bias_virial().as_flattened()).enumerate()
        {
            let alone = physical.virial.as_flattened()[k];
            assert!((total - of_bias - alone).abs() <= 1e-10 * (1.0 + alone.abs()), "{call}");
        }
        assert_eq!((state, &gamma), (biased.state, &biased.grades(&moved, &neighbours).unwrap().gamma));
    }
    assert_eq!(measured, [0, 1, 2, 3, 4, 6, 9, 12]);
    assert_eq!(biased.state.evaluations, 15);
}

/// The first steps of a walk from the slab at constant volume, without candidates.
fn on_the_slab(interval: u64, trace_interval: u64, last_step: u64) -> (WalkSettings, Assignment) {
    let settings =
        WalkSettings { bias_norm_interval: interval, trace_interval, collection: never(), ..settings() };
    let conditions = WalkConditions { tau: 0.3, cell: CellConditions::Fixed, ..conditions() };
    (settings, Assignment { conditions, ..assignment(seed_structure("slab-111"), last_step) })
}

/// The structures of a walk, from its start on.
fn path(settings: &WalkSettings, first: &Assignment) -> Vec<Structure> {
    let (model, settings) = (model(), Arc::new(settings.clone()));
    let context = WalkContext { model, threads: Threads::default(), settings, original: mixture() };
    let mut path = Vec::new();
    let observe = |view: &mut workers::walk::StepView<'_, '_>| path.push(view.structure().clone());
    advance_observed(&context, first, mixture(), || false, |_| {}, observe).unwrap();
    path
}

/// It leaves the path of a walk that measures at each step after the first step with a bias, and slowly: by less than 10⁻³ Å in ten steps
/// of 2 fs.
#[test]
fn the_walk_stays_close_to_one_that_measures_always() {
    let paths = [1, 5].map(|interval| {
        let (settings, first) = on_the_slab(interval, 0, 42);
        path(&settings, &first)
    });
    let largest = |step: usize| {
        let pairs = paths[0][step].positions.iter().zip(&paths[1][step].positions);
        pairs.map(|(a, b)| cell::norm(cell::sub(*a, *b))).fold(0.0, f64::max)
    };
    // Twenty steps without a bias, ten in which the averages settle, one with a bias of norms of its own, and its kick.
    assert!((0..=32).all(|step| largest(step) == 0.0));
    assert!(largest(34) > 0.0, "other norms from step 32 on");
    assert!(largest(42) < 1e-3, "{}", largest(42));
}

#[test]
fn a_split_assignment_gives_the_same_result() {
    for cell in [CellConditions::Fixed, CellConditions::VolumeRamp { from: 0.98, to: 1.1 }] {
        let (settings, mut next) = on_the_slab(4, 7, 90);
        next.conditions.cell = cell;
        let whole = run(&settings, &next);
        assert_eq!((&whole.outcome, whole.progress.step), (&Outcome::StepsDone, 90));
        let mut trace = Vec::new();
        for last_step in [1, 20, 30, 31, 32, 33, 34, 35, 36, 61, 90] {
            next.last_step = last_step;
            let report = run(&settings, &next);
            trace.extend(report.trace);
            next.checkpoint = Some(report.checkpoint);
        }
        assert_eq!(next.checkpoint, Some(whole.checkpoint));
        assert_eq!(trace, whole.trace);
    }
}

/// What is recorded does not change the walk.
#[test]
fn traces_change_nothing() {
    let [without, with] = [0, 1].map(|trace_interval| {
        let (settings, first) = on_the_slab(4, trace_interval, 60);
        path(&settings, &first)
    });
    assert!(without == with);
}

/// The first points of a trace, up to rounding those of a walk that measures always; its work is known at measured steps.
#[test]
fn points_are_those_of_a_walk_that_measures_always() {
    let [always, seldom] = [1, 50].map(|interval| {
        let (settings, first) = on_the_slab(interval, 1, 33);
        run(&settings, &first).trace
    });
    // The bias of step 32 has the norms of step 31, which are about those of its own.
    for (a, b) in always.iter().zip(&seldom) {
        let values = |point: &TracePoint| {
            [point.bias_scale, point.bias_share, point.pressure.unwrap(), point.temperature]
        };
        let tolerance = if a.step < 32 { 0.0 } else { 0.02 };
        for (a, b) in values(a).into_iter().zip(values(b)) {
            assert!((a - b).abs() <= tolerance * a.abs(), "{a} {b}");
        }
    }
    assert_eq!(always[31].bias_work, seldom[31].bias_work);
    assert_ne!(always[32].bias_work, seldom[32].bias_work);
    assert_eq!(seldom[31].bias_work, seldom[33].bias_work);
}

/// At constant energy otherwise, the work of the bias is the gain of energy, where it is known.
#[test]
fn the_work_of_the_bias_is_the_gain_of_energy() {
    let (settings, first) = on_the_slab(4, 1, 200);
    let settings = WalkSettings {
        thermostat: NVE,
        equilibration_steps: 0,
        zbl: None,
        bias_averaging_steps: 1,
        ..settings
    };
    let trace = run(&settings, &first).trace;
    let balance = |point: &TracePoint| point.conserved_energy.unwrap() - point.bias_work;
    let known = trace.iter().filter(|point| point.step % 4 == 1);
    let missing = known.map(|point| (balance(point) - balance(&trace[0])).abs()).fold(0.0, f64::max);
    let work = trace.last().unwrap().bias_work;
    assert!(work > 0.3 && missing < 0.1 * work, "{missing} of {work}");
}

/// Candidates have the energy, forces and virial of the model alone, whatever their step knows.
#[test]
fn candidates_have_the_forces_of_the_model() {
    let (without_candidates, mut next) = on_the_slab(7, 0, 47);
    next.checkpoint = Some(run(&without_candidates, &next).checkpoint);
    next.last_step = 600;
    let report = run(&WalkSettings { bias_norm_interval: 7, ..settings() }, &next);
    let Outcome::Candidate(candidate) = report.outcome else { panic!("{:?}", report.outcome) };
    assert_eq!(candidate.id.step, 48, "steps 44 and 51 measure the norms");
    let model = model();
    let mut neighbours = NeighbourList::new(model.cutoff(), 0.0);
    neighbours.update(&candidate.structure).unwrap();
    let (physical, _) = reference(&model, &mixture(), &candidate.structure, &neighbours);
    let error = candidate.forces.iter().zip(&physical.forces).map(|(a, b)| cell::norm(cell::sub(*a, *b)));
    assert!(error.fold(0.0, f64::max) < 1e-10 && (candidate.energy - physical.energy()).abs() < 1e-10);
    let pairs = candidate.virial.as_flattened().iter().zip(physical.virial.as_flattened());
    assert!(pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max) < 1e-9);
}

/// At constant pressure, each step needs the virial without bias.
#[test]
fn walks_at_constant_pressure_measure_always() {
    let walk = |interval: u64| {
        let (settings, mut first) = on_the_slab(interval, 0, 50);
        first.seed_structure = seed_structure("vacancy");
        let constant = ConstantPressure { pressure: 1.0, start_volume: 1.0, cell_bias: false };
        first.conditions.cell = CellConditions::ConstantPressure(constant);
        run(&settings, &first).checkpoint
    };
    assert!(walk(1) == walk(5));
}
