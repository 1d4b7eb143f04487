//! What a moving cell must not depend on, where it stops, and what is refused.

use atoms::cell::{add, cross, norm, row_times, scale, sub};
use atoms::{
    Evaluation, Matrix3, NeighbourList, Potential, PotentialError, Repetition, Species, Structure, Vec3,
};
use md::{
    BAR_PER_EV_A3, BarostatSettings, CellFreedom, Checkpoint, Dynamics, DynamicsError, DynamicsSettings,
    NoseHooverChain, State, Thermostat,
};

use crate::common::{LennardJones, argon_crystal, settings, with_barostat};

fn chain() -> Thermostat {
    Thermostat::NoseHooverChain(NoseHooverChain::new(20.0, 100.0, 3))
}

fn barostat(cell: CellFreedom) -> BarostatSettings {
    BarostatSettings { pressure: 300.0, cell, relaxation_time: 200.0, ..BarostatSettings::default() }
}

fn start(structure: Structure, barostat: &BarostatSettings) -> (Dynamics, LennardJones) {
    let settings = with_barostat(settings(4.0, chain()), barostat, 20.0, &structure);
    let state = State::thermal(structure, 20.0, &settings.stream);
    let mut potential = LennardJones::argon();
    (Dynamics::new(state, settings, &mut potential).unwrap(), potential)
}

fn run(dynamics: &mut Dynamics, potential: &mut LennardJones, steps: usize) {
    (0..steps).for_each(|_| dynamics.step(potential).unwrap());
}

/// The largest difference.
fn distance(a: &[Vec3], b: &[Vec3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| norm(sub(*a, *b))).fold(0.0, f64::max)
}

/// A rotation about an oblique axis.
const TURN: Matrix3 = [
    [2.0 / 3.0, -1.0 / 3.0, 2.0 / 3.0],
    [2.0 / 3.0, 2.0 / 3.0, -1.0 / 3.0],
    [-1.0 / 3.0, 2.0 / 3.0, 2.0 / 3.0],
];

fn turned(vectors: &[Vec3]) -> Vec<Vec3> {
    vectors.iter().map(|v| row_times(*v, &TURN)).collect()
}

#[test]
fn a_turned_structure_moves_alike() {
    for periodic in [[true; 3], [true, false, true], [false, true, false]] {
        for cell in [CellFreedom::Flexible, CellFreedom::Isotropic, CellFreedom::FixedAngles] {
            let mut structure = argon_crystal(2);
            structure.periodic = periodic;
            structure.cell.0[0] = [10.8, 0.7, -0.4];
            let pressure = if periodic == [true; 3] { 300.0 } else { 0.0 };
            let (mut dynamics, mut potential) =
                start(structure, &BarostatSettings { pressure, ..barostat(cell) });
            run(&mut dynamics, &mut potential, 20);
            let mut other = dynamics.checkpoint().clone();
            other.state.structure.positions = turned(&other.state.structure.positions);
            other.state.structure.cell.0 = other.state.structure.cell.0.map(|row| row_times(row, &TURN));
            other.state.velocities = turned(&other.state.velocities);
            let mut other = restarted(other, &mut potential);
            let mut first = restarted(dynamics.checkpoint().clone(), &mut potential);
            run(&mut first, &mut potential, 200);
            run(&mut other, &mut potential, 200);
            let moved = distance(&first.structure().positions, &dynamics.structure().positions);
            let error = distance(&turned(&first.structure().positions), &other.structure().positions);
            assert!(moved > 0.1 && error < 1e-8, "{error} Å after {moved} Å with {cell:?}");
            let stretched = distance(&first.structure().cell.0, &dynamics.structure().cell.0);
            let error = distance(&turned(&first.structure().cell.0), &other.structure().cell.0);
            assert!(stretched > 1e-3 && error < 1e-9, "{error} Å after {stretched} Å with {cell:?}");
        }
    }
}

/// A run from the structure and velocities of a checkpoint, with a barostat at rest.
fn restarted(checkpoint: Checkpoint, potential: &mut LennardJones) -> Dynamics {
    let Checkpoint { state, thermostat, mut cell_motion, time_step, stream, .. } = checkpoint;
    if let md::CellMotion::Barostat(barostat) = &mut cell_motion {
        barostat.strain_rate = Matrix3::default();
    }
    let settings = DynamicsSettings { time_step, thermostat, cell_motion, stream, skin: 0.6 };
    Dynamics::new(state, settings, potential).unwrap()
}

/// The same lattice by skew vectors: they are reduced at the first step, and the atoms move as before, up to lattice
/// vectors.
#[test]
fn a_skew_cell_is_reduced_and_moves_alike() {
    let straight = argon_crystal(2);
    let mut skew = straight.clone();
    let [a, b, c] = skew.cell.0;
    skew.cell.0 = [a, add(b, scale(a, -3.0)), add(c, sub(scale(b, 2.0), a))];
    let settings = barostat(CellFreedom::Flexible);
    let (mut first, mut potential) = start(straight, &settings);
    let (mut second, _) = start(skew, &settings);
    run(&mut first, &mut potential, 200);
    run(&mut second, &mut potential, 200);
    let (first, second) = (first.structure(), second.structure());
    assert!(second.cell.heights().iter().all(|height| *height > 10.0), "{:?}", second.cell);
    assert!((second.cell.signed_volume() - first.cell.signed_volume()).abs() < 1e-8);
    for (r, other) in first.positions.iter().zip(&second.positions) {
        let apart = first.cell.fractional(sub(*r, *other));
        assert!(apart.iter().all(|x| (x - x.round()).abs() < 1e-9), "{apart:?}");
    }
}

#[test]
fn lattice_vectors_keep_their_directions_at_fixed_angles() {
    let mut structure = argon_crystal(2);
    let [a, b, c] = structure.cell.0;
    structure.cell.0 = [a, add(b, scale(a, -1.0)), c];
    let before = structure.cell.0;
    let (mut dynamics, mut potential) = start(structure, &barostat(CellFreedom::FixedAngles));
    run(&mut dynamics, &mut potential, 200);
    for (before, after) in before.iter().zip(&dynamics.structure().cell.0) {
        let off = norm(cross(*before, *after)) / norm(*before) / norm(*after);
        assert!(off < 1e-12 && norm(sub(*before, *after)) > 1e-2, "{before:?} {after:?}");
    }
}

#[test]
fn directions_that_are_not_periodic_do_not_move() {
    for cell in [CellFreedom::Flexible, CellFreedom::Isotropic, CellFreedom::FixedAngles] {
        let mut slab = argon_crystal(2);
        slab.periodic = [true, true, false];
        slab.cell.0[2] = [0.0; 3];
        let settings = BarostatSettings { pressure: 1.0, ..barostat(cell) };
        let (mut dynamics, mut potential) = start(slab.clone(), &settings);
        assert_eq!(dynamics.barostat().unwrap().pressure, 0.0);
        run(&mut dynamics, &mut potential, 300);
        let after = &dynamics.structure().cell.0;
        assert!(after[2] == [0.0; 3] && after[0][2].abs() < 1e-12 && after[1][2].abs() < 1e-12, "{after:?}");
        assert!(norm(sub(after[0], slab.cell.0[0])) > 1e-3);
    }
}

#[test]
fn the_volume_is_reflected_at_its_boundaries() {
    let (mut dynamics, mut potential) = start(argon_crystal(2), &barostat(CellFreedom::Flexible));
    let volume = dynamics.structure().cell.volume();
    let [least, most] = [0.99 * volume, 1.01 * volume];
    dynamics.set_volume_range(Some([least, most])).unwrap();
    let mut touched = [0, 0];
    for _ in 0..2000 {
        let reflections = dynamics.barostat().unwrap().reflections;
        dynamics.step(&mut potential).unwrap();
        let (after, now) = (dynamics.barostat().unwrap().reflections, dynamics.structure().cell.volume());
        assert!(now > least * (1.0 - 1e-12) && now < most * (1.0 + 1e-12), "{now} of {volume}");
        if after > reflections {
            let is_upper = now > volume;
            touched[usize::from(is_upper)] += after - reflections;
            assert!((now / if is_upper { most } else { least } - 1.0).abs() < 1e-12, "{now} of {volume}");
        }
    }
    let reflections = dynamics.barostat().unwrap().reflections;
    assert!(touched.iter().sum::<u64>() == reflections && reflections > 3, "{touched:?} of {reflections}");
}

/// A constant bias stress acts as an external stress of the opposite sign, and none leaves the run as it is.
#[test]
fn the_bias_stress_acts_on_the_cell() {
    let stress = [[-200.0, 50.0, 0.0], [50.0, 100.0, 0.0], [0.0, 0.0, 0.0]]
        .map(|row: Vec3| scale(row, 1.0 / BAR_PER_EV_A3));
    let settings = barostat(CellFreedom::Flexible);
    let external = BarostatSettings { stress: [200.0, -100.0, 0.0, 0.0, 0.0, -50.0], ..settings };
    let (mut pulled, mut potential) = start(argon_crystal(2), &external);
    let (mut biased, _) = start(argon_crystal(2), &settings);
    let mut checkpoint = biased.checkpoint().clone();
    if let md::CellMotion::Barostat(barostat) = &mut checkpoint.cell_motion {
        barostat.bias_stress = stress;
    }
    biased = Dynamics::resume(checkpoint, 7.0, 0.6).unwrap();
    let (mut none, mut plain) = (start(argon_crystal(2), &settings).0, start(argon_crystal(2), &settings).0);
    for _ in 0..200 {
        pulled.step(&mut potential).unwrap();
        biased.step_with_bias_stress(&mut potential, |_, _| stress).unwrap();
        none.step_with_bias_stress(&mut potential, |_, _| Matrix3::default()).unwrap();
        plain.step(&mut potential).unwrap();
    }
    assert_eq!(none.checkpoint(), plain.checkpoint());
    assert!(distance(&pulled.structure().positions, &biased.structure().positions) < 1e-9);
    assert!(distance(&plain.structure().cell.0, &biased.structure().cell.0) > 0.01);
    let [first, second] = [&pulled, &biased].map(|dynamics| dynamics.barostat().unwrap().work);
    assert!(first > 1e-3 && (first - second).abs() < 1e-10, "{first} eV, {second} eV");
}

#[test]
fn impossible_barostats_are_refused() {
    let refused = |periodic: [bool; 3], settings: BarostatSettings| {
        let mut structure = argon_crystal(1);
        structure.periodic = periodic;
        let run = with_barostat(self::settings(4.0, chain()), &settings, 20.0, &structure);
        let state = State::thermal(structure, 20.0, &run.stream);
        match Dynamics::new(state, run, &mut LennardJones::argon()) {
            Err(DynamicsError::Barostat(reason)) => reason,
            other => panic!("{:?}", other.map(|_| ())),
        }
    };
    let usual = BarostatSettings::default();
    assert!(refused([false; 3], usual).contains("cluster"));
    assert!(refused([true, true, false], BarostatSettings { pressure: 1e4, ..usual }).contains("slab"));
    assert!(refused([true; 3], BarostatSettings { relaxation_time: 0.0, ..usual }).contains("damping time"));
    assert!(refused([true; 3], BarostatSettings { pressure: f64::NAN, ..usual }).contains("finite"));
    let (dynamics, _) = start(argon_crystal(1), &usual);
    let mut skew = dynamics.checkpoint().clone();
    skew.state.structure.cell.0[1] = [16.2, 5.4, 0.0];
    assert!(Dynamics::resume(skew.clone(), 7.0, 0.6).is_ok());
    if let md::CellMotion::Barostat(barostat) = &mut skew.cell_motion {
        barostat.freedom = CellFreedom::FixedAngles;
    }
    assert!(matches!(Dynamics::resume(skew, 7.0, 0.6), Err(DynamicsError::Barostat(_))));
    let mut other = dynamics.checkpoint().clone();
    other.thermostat = Thermostat::None;
    assert!(matches!(Dynamics::resume(other, 7.0, 0.6), Err(DynamicsError::Barostat(_))));
    let wrong =
        BarostatSettings { stress: [0.0, f64::INFINITY, 0.0, 0.0, 0.0, 0.0], ..usual }.wrong().unwrap();
    assert_eq!((wrong.key, usual.wrong()), ("stress", None));
}

#[test]
fn a_cell_that_is_torn_apart_ends_in_an_error() {
    let end = |settings: BarostatSettings| {
        let (mut dynamics, mut potential) = start(argon_crystal(2), &settings);
        (0..20_000).find_map(|_| dynamics.step(&mut potential).err()).unwrap()
    };
    let usual = barostat(CellFreedom::Flexible);
    let slow = BarostatSettings { pressure: -5000.0, relaxation_time: 1000.0, ..usual };
    assert!(matches!(end(slow), DynamicsError::CellVolume { ratio, .. } if ratio > 4.0));
    let fast = BarostatSettings { pressure: -1e7, ..usual };
    assert!(matches!(end(fast), DynamicsError::CellStrain { percent, .. } if percent > 5.0));
}

/// Argon whose virial is lost after some evaluations.
struct WithoutVirial(LennardJones);

impl Potential for WithoutVirial {
    fn cutoff(&self) -> f64 {
        self.0.cutoff()
    }

    fn species(&self) -> &[Species] {
        self.0.species()
    }

    fn evaluate(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        self.0.evaluate(structure, neighbours, out)?;
        if self.0.evaluations > 3 {
            out.virial[1][2] = f64::NAN;
        }
        Ok(())
    }
}

#[test]
fn a_stress_that_is_not_finite_ends_a_run_with_a_barostat_only() {
    let end = |with_a_barostat: bool| {
        let structure = argon_crystal(2);
        let mut run = settings(4.0, chain());
        if with_a_barostat {
            run = with_barostat(run, &barostat(CellFreedom::Flexible), 20.0, &structure);
        }
        let state = State::thermal(structure, 20.0, &run.stream);
        let mut potential = WithoutVirial(LennardJones::argon());
        let mut dynamics = Dynamics::new(state, run, &mut potential).unwrap();
        (0..10).find_map(|_| dynamics.step(&mut potential).err())
    };
    // The first evaluation is that of the start.
    assert!(matches!(end(true), Some(DynamicsError::StressNotFinite { step: 2 })), "{:?}", end(true));
    assert!(end(false).is_none());
}

/// A cell of 5.4 Å and a cutoff of 7 Å: each atom sees several images of its neighbours and of itself. At any volume its energy,
/// forces and virial are those of a supercell, and the enthalpy is conserved to second order in the time step.
#[test]
fn a_cell_thinner_than_the_cutoff_moves_like_any_other() {
    let mut potential = LennardJones::argon();
    let mut pressed = |time_step: f64| {
        let structure = argon_crystal(1);
        let set = BarostatSettings { pressure: 3000.0, ..barostat(CellFreedom::Flexible) };
        let run = with_barostat(settings(time_step, Thermostat::None), &set, 20.0, &structure);
        let start = State::thermal(structure, 20.0, &run.stream);
        let mut dynamics = Dynamics::new(start, run, &mut potential).unwrap();
        let (volume, enthalpy) = (dynamics.structure().cell.volume(), dynamics.conserved_energy().unwrap());
        let (mut smallest, mut error) = (volume, 0.0_f64);
        for _ in 0..(1000.0 / time_step) as u64 {
            dynamics.step(&mut potential).unwrap();
            smallest = smallest.min(dynamics.structure().cell.volume());
            error = error.max((dynamics.conserved_energy().unwrap() - enthalpy).abs());
        }
        assert!(smallest < 0.9 * volume, "{smallest} of {volume} Å³");
        (dynamics, error)
    };
    let ((_, coarse), (dynamics, fine)) = (pressed(2.0), pressed(1.0));
    assert!(fine < 0.3 * coarse, "{fine} eV after {coarse} eV");
    let repetition = Repetition::for_size(dynamics.structure(), 1, 15.0);
    let wide = dynamics.structure().repeated(repetition);
    let mut neighbours = NeighbourList::new(potential.cutoff(), 0.0);
    neighbours.update(&wide).unwrap();
    let mut expected = Evaluation::default();
    potential.evaluate(&wide, &neighbours, &mut expected).unwrap();
    let (cells, found) = (repetition.cells() as f64, dynamics.evaluation());
    assert!(cells >= 27.0 && (found.energy() * cells - expected.energy()).abs() < 1e-9);
    assert!(distance(&found.forces, &expected.forces[..4]) < 1e-9);
    assert!(distance(&found.virial.map(|row| scale(row, cells)), &expected.virial) < 1e-9);
}
