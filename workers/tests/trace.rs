//! Traces of walks: their points are the state of the dynamics, and the work of the bias is where the energy comes from.

use std::sync::Arc;

use atoms::units::GPA_PER_EV_A3;
use atoms::{NeighbourList, Vec3, cell};
use md::{BarostatSettings, Dynamics, DynamicsSettings, State, Stream, ThermostatSettings};
use potentials::grace::Grace;
use wire::messages::{Assignment, Outcome};
use wire::{CellConditions, Origin, TracePoint, WalkConditions};
use workers::bias::BiasedPotential;
use workers::settings::WalkSettings;
use workers::walk::is_same_state;

use crate::walk::{
    assignment, conditions, first_of, mixture, model, never, reference, run, seed_structure, settings,
    uniform_zbl, whole_walk,
};

const NVE: ThermostatSettings = ThermostatSettings::None {};

/// Settings of a walk without candidates, at constant energy, with a point after every tenth step.
fn steady() -> WalkSettings {
    let (thermostat, trace_interval, zbl) = (NVE, 10, None);
    WalkSettings { collection: never(), thermostat, trace_interval, zbl, ..settings() }
}

/// The first steps of a walk from the slab, whose atoms have forces and a gradient of γ, in a fixed cell.
fn on_the_slab(tau: f64, last_step: u64) -> Assignment {
    let conditions = WalkConditions { tau, cell: CellConditions::Fixed, ..conditions() };
    Assignment { conditions, ..assignment(seed_structure("slab-111"), last_step) }
}

fn close(found: f64, expected: f64) -> bool {
    (found - expected).abs() <= 1e-9 * (1.0 + expected.abs())
}

#[test]
fn points_are_the_state_of_the_dynamics() {
    let (settings, first) = (steady(), on_the_slab(0.3, 60));
    let trace = run(&settings, &first).trace;
    assert_eq!(trace.iter().map(|point| point.step).collect::<Vec<_>>(), [0, 10, 20, 30, 40, 50, 60]);
    let structure = first.seed_structure.clone();
    let (model, mixture) = (model(), mixture());
    let grace = Box::new(Grace::new(Arc::clone(&model)));
    let mut potential =
        BiasedPotential::new(grace, Arc::clone(&mixture), None, 10, &structure.species).unwrap();
    let stream = Stream::new(settings.rng_seed, 0, 0);
    let start = State::thermal(structure.clone(), 600.0, &stream);
    let (thermostat, skin) = (NVE.start(600.0), settings.skin);
    let run = DynamicsSettings { time_step: 2.0, thermostat, cell_motion: Default::default(), stream, skin };
    let mut dynamics = Dynamics::new(start, run, &mut potential).unwrap();
    let (mut work, mut power) = (0.0, 0.0);
    for (number, point) in trace.iter().enumerate() {
        while dynamics.state().step < point.step {
            potential.tau = if dynamics.state().step >= settings.equilibration_steps { 0.3 } else { 0.0 };
            dynamics.step(&mut potential).unwrap();
            // The force of the bias is what the potential's own forces do not explain.
            let velocities = &dynamics.state().velocities;
            let pairs = dynamics.evaluation().forces.iter().zip(&potential.physical().forces).zip(velocities);
            let now: f64 = pairs.map(|((all, physical), v)| cell::dot(cell::sub(*all, *physical), *v)).sum();
            work += 0.5 * 2.0 * (power + now);
            power = now;
        }
        let moved = dynamics.structure();
        let mut neighbours = NeighbourList::new(model.cutoff(), 0.0);
        neighbours.update(moved).unwrap();
        let (physical, gradient) = reference(&model, &mixture, moved, &neighbours);
        let norms = |vectors: &[Vec3]| vectors.iter().map(|v| cell::norm(*v)).sum::<f64>();
        let state = potential.state;
        // The bias is zero for its first ten evaluations.
        let scale = if point.step > 30 { 0.3 * state.force_norm / state.gradient_norm } else { 0.0 };
        let share = scale * norms(&gradient.gradient) / norms(&physical.forces);
        let virial: f64 = (0..3).map(|k| physical.virial[k][k]).sum();
        let kinetic = dynamics.kinetic_energy();
        let pressure = GPA_PER_EV_A3 * (2.0 * kinetic + virial) / (3.0 * moved.cell.volume());
        assert_eq!((point.number, point.segment, point.time), (number as u64, 0, 2.0 * point.step as f64));
        assert_eq!((point.relative_volume, point.cell_gain), (1.0, 0.0));
        assert_eq!(point.cell, Some(structure.cell.lengths_and_angles()));
        let expected_energy = kinetic + physical.energy();
        for (what, found, expected) in [
            ("temperature", point.temperature, dynamics.temperature()),
            ("pressure", point.pressure.unwrap(), pressure),
            ("energy", point.conserved_energy.unwrap(), expected_energy),
            ("scale", point.bias_scale, scale),
            ("share", point.bias_share, share),
            ("work", point.bias_work, work),
        ] {
            assert!(close(found, expected), "{what} of step {}: {found}, not {expected}", point.step);
        }
        let mut grades = calm::Grades::default();
        let elements = model.element_indices(&moved.species).unwrap();
        let mut grace = Grace::new(Arc::clone(&model));
        potentials::PotentialWithFeatures::forward(&mut grace, moved, &neighbours).unwrap();
        let features = potentials::PotentialWithFeatures::features(&grace);
        grades.evaluate(&mixture, &elements, features, None).unwrap();
        let gamma_max = calm::grade::maximum(&grades.gamma);
        assert!(close(point.gamma_max.unwrap(), gamma_max), "{point:?}, not {gamma_max}");
    }
    assert!(trace[6].bias_scale > 0.0 && trace[6].bias_work.abs() > 1e-3, "{:?}", trace[6]);
}

/// Change of the energy less the work of the bias over the steps in which it acts: largest, and the work itself.
fn missing_energy(trace: &[TracePoint]) -> (f64, f64) {
    let balance = |point: &TracePoint| point.conserved_energy.unwrap() - point.bias_work;
    let start = balance(&trace[0]);
    let missing = trace.iter().map(|point| (balance(point) - start).abs()).fold(0.0, f64::max);
    (missing, trace.last().unwrap().bias_work)
}

/// The first law: at constant energy otherwise, the work of the bias is the gain of kinetic and potential energy, within the
/// error of the integrator, which is of second order in the time step.
#[test]
fn the_work_of_the_bias_is_the_gain_of_energy() {
    let walk = |time_step: f64| {
        let settings = WalkSettings {
            time_step: Some(time_step),
            equilibration_steps: 0,
            bias_averaging_steps: 1,
            trace_interval: 1,
            ..steady()
        };
        let report = run(&settings, &on_the_slab(0.3, (400.0 / time_step) as u64));
        assert_eq!(report.outcome, Outcome::StepsDone);
        missing_energy(&report.trace)
    };
    let [(coarse, work), (fine, _)] = [2.0, 1.0].map(walk);
    assert!(work > 0.3, "{work}");
    assert!(coarse < 0.05 * work, "{coarse} of {work}");
    assert!(fine < 0.4 * coarse, "{fine} after {coarse}");
}

/// It pushes atoms to where grades are larger, so its mean work is positive, and grades are larger than without it.
#[test]
fn the_bias_works_along_the_gradient_of_the_grades() {
    let walks = |tau: f64| {
        let walk = |(number, name): (u64, &str)| {
            let settings = WalkSettings { rng_seed: number, thermostat: settings().thermostat, ..steady() };
            let first = Assignment { seed_structure: seed_structure(name), ..on_the_slab(tau, 400) };
            let trace = run(&settings, &first).trace;
            let late = &trace[trace.len() / 2..];
            let grade = late.iter().map(|point| point.gamma_max.unwrap()).sum::<f64>() / late.len() as f64;
            (trace.last().unwrap().bias_work, grade)
        };
        let names = ["slab-111", "vacancy", "fcc-100", "slab-111", "vacancy", "fcc-103"];
        (1..).zip(names).map(walk).collect::<Vec<_>>()
    };
    let (biased, weak) = (walks(0.3), walks(1e-9));
    let works: Vec<f64> = biased.iter().map(|(work, _)| *work).collect();
    let mean = works.iter().sum::<f64>() / works.len() as f64;
    let variance = works.iter().map(|work| (work - mean).powi(2)).sum::<f64>() / (works.len() - 1) as f64;
    let error = (variance / works.len() as f64).sqrt();
    assert!(mean > 2.0 * error && mean > 0.1, "{mean} ± {error} eV: {works:?}");
    let larger = biased.iter().zip(&weak).filter(|((_, with), (_, without))| with > without).count();
    assert!(larger >= 5, "{biased:?} {weak:?}");
}

/// The bias on a moving cell is counted by its barostat, that on the atoms is the work of the trace: nothing is missing.
#[test]
fn the_work_of_the_bias_with_a_moving_cell_is_the_gain_of_energy() {
    let structure = seed_structure("vacancy");
    let missing = |time_step: f64| {
        let grace = Box::new(Grace::new(model()));
        let mut potential = BiasedPotential::new(grace, mixture(), None, 1, &structure.species).unwrap();
        potential.tau = 0.3;
        let (thermostat, stream) = (NVE.start(600.0), Stream::new(3, 0, 0));
        let barostat = BarostatSettings { relaxation_time: 200.0, ..BarostatSettings::default() };
        let cell_motion = barostat.start(600.0, &thermostat, &structure).into();
        let run = DynamicsSettings { time_step, thermostat, cell_motion, stream, skin: 0.5 };
        let start = State::thermal(structure.clone(), 600.0, &stream);
        let mut dynamics = Dynamics::new(start, run, &mut potential).unwrap();
        let start = dynamics.conserved_energy().unwrap();
        let mut missing = 0.0_f64;
        for _ in 0..(400.0 / time_step) as u64 {
            dynamics.step_with_bias_stress(&mut potential, |bias, _| bias.cell_stress(0.005)).unwrap();
            let power = potential.bias_power(&dynamics.state().velocities);
            potential.state.work.advance(power, time_step);
            let gained = dynamics.conserved_energy().unwrap() - start;
            missing = missing.max((gained - potential.state.work.total).abs());
        }
        (missing, potential.state.work.total, dynamics.barostat().unwrap().work)
    };
    let [(coarse, work, of_cell), (fine, ..)] = [2.0, 1.0].map(missing);
    assert!(coarse < 0.2 * work.abs() && coarse < 0.5 * of_cell.abs(), "{coarse} of {work} and {of_cell}");
    assert!(fine < 0.4 * coarse, "{fine} after {coarse}");
}

#[test]
fn a_split_assignment_gives_the_same_points() {
    let settings = steady();
    let whole = run(&settings, &on_the_slab(0.3, 120)).trace;
    assert_eq!(whole.len(), 13);
    let (mut next, mut split) = (on_the_slab(0.3, 0), Vec::new());
    for last_step in [0, 1, 9, 10, 11, 33, 90, 120] {
        next.last_step = last_step;
        let report = run(&settings, &next);
        next.checkpoint = Some(report.checkpoint);
        split.extend(report.trace);
    }
    assert_eq!(split, whole);
}

#[test]
fn an_abandoned_path_keeps_its_points_and_the_work_is_that_of_the_path() {
    let settings = WalkSettings { zbl: uniform_zbl(1.0, 1.8), trace_interval: 4, ..settings() };
    let reports = whole_walk(&settings, first_of("fcc-100", WalkConditions { tau: 2.0, ..conditions() }));
    let trace: Vec<_> = reports.iter().flat_map(|report| &report.trace).collect();
    assert!(trace.iter().zip(0..).all(|(point, number)| point.number == number));
    let back: Vec<_> = trace.windows(2).filter(|pair| pair[0].segment != pair[1].segment).collect();
    assert_eq!(back.len() as u32, reports.last().unwrap().progress.rollbacks);
    assert!(!back.is_empty());
    for pair in back {
        let [left, next] = pair else { panic!("two points") };
        assert!(next.step <= left.step && next.segment == left.segment + 1, "{left:?} {next:?}");
        let before = |point: &&&TracePoint| point.segment <= left.segment && point.step < next.step;
        let target = trace.iter().rfind(before).unwrap();
        let others = |point: &TracePoint| (point.bias_work - target.bias_work).abs();
        assert!(others(next) < 0.2 * others(left), "{target:?} {left:?} {next:?}");
    }
}

#[test]
fn a_control_walk_has_a_trace_without_bias() {
    let control = Assignment { origin: Origin::Control, ..on_the_slab(0.3, 100) };
    let (settings, biased) = (steady(), run(&steady(), &on_the_slab(0.3, 100)).trace);
    let control = run(&settings, &control).trace;
    assert_eq!(control.len(), biased.len());
    for (point, biased) in control.iter().zip(&biased) {
        assert_eq!((point.bias_scale, point.bias_share, point.bias_work), (0.0, 0.0, 0.0));
        assert!(point.gamma_max.is_some_and(|gamma| gamma > 0.0));
        // The bias acts from step 31 on.
        assert_eq!(point == biased, point.step <= 30, "{point:?} {biased:?}");
    }
}

#[test]
fn the_trace_changes_no_result() {
    let at = |trace_interval: u64| {
        let settings = WalkSettings { trace_interval, collection: never(), ..settings() };
        let report = run(&settings, &assignment(seed_structure("vacancy"), 90));
        (report.progress, report.outcome, report.trace.len(), report.checkpoint)
    };
    let ((progress, outcome, points, plain), (with, same, one, traced)) = (at(0), at(7));
    assert_eq!((with, same), (progress, outcome));
    assert_eq!((points, one), (0, 13));
    assert!(plain != traced && is_same_state(&plain, &traced) == Some(true));
    let later = run(&settings(), &assignment(seed_structure("vacancy"), 91)).checkpoint;
    assert_eq!((is_same_state(&plain, &later), is_same_state(&plain, b"")), (Some(false), None));
}
