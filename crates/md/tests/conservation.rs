//! Properties that an integrator must conserve: energy to second order, momentum, and time reversal.

use md::{
    BarostatSettings, CellFreedom, CellMotion, CellThermostat, Checkpoint, Dynamics, DynamicsSettings,
    NoseHooverChain, Thermostat, VelocityRescaling, VolumeRamp,
};

use crate::common::{LennardJones, argon_crystal, settings, warm_argon, with_barostat};

/// Root mean square fluctuation of the conserved energy over 1.6 ps from one starting point.
fn fluctuation(start: &Checkpoint, time_step: f64) -> f64 {
    let mut potential = LennardJones::argon();
    let checkpoint = Checkpoint { time_step, ..start.clone() };
    let mut dynamics = Dynamics::resume(checkpoint, 7.0, 0.6).unwrap();
    let energies: Vec<f64> = (0..(1600.0 / time_step) as usize)
        .map(|_| {
            dynamics.step(&mut potential).unwrap();
            dynamics.conserved_energy().unwrap()
        })
        .collect();
    let mean = energies.iter().sum::<f64>() / energies.len() as f64;
    (energies.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / energies.len() as f64).sqrt()
}

const FREEDOMS: [CellFreedom; 3] = [CellFreedom::Flexible, CellFreedom::Isotropic, CellFreedom::FixedAngles];

fn chain() -> Thermostat {
    Thermostat::NoseHooverChain(NoseHooverChain::new(60.0, 100.0, 3))
}

/// A cell that moves fast, also by shear.
fn fast_cell(cell: CellFreedom) -> BarostatSettings {
    let stress = [300.0, 0.0, -200.0, 150.0, 0.0, -100.0];
    BarostatSettings { pressure: 400.0, stress, cell, relaxation_time: 300.0 }
}

/// At 2 fs the conserved energy fluctuates by less than `accuracy` times the kinetic energy.
fn is_second_order(settings: DynamicsSettings, accuracy: f64) {
    let (dynamics, _) = warm_argon(2, 80.0, settings, 300);
    let [coarse, middle, fine] = [8.0, 4.0, 2.0].map(|dt| fluctuation(dynamics.checkpoint(), dt));
    let kinetic = dynamics.kinetic_energy();
    assert!(fine < accuracy * kinetic, "fluctuation {fine} eV of {kinetic} eV");
    for ratio in [coarse / middle, middle / fine] {
        assert!((ratio - 4.0).abs() < 0.4, "halving the time step divides the error by {ratio}");
    }
}

#[test]
fn constant_energy_is_conserved_to_second_order() {
    is_second_order(settings(5.0, Thermostat::None), 1e-4);
}

#[test]
fn nose_hoover_energy_is_conserved_to_second_order() {
    is_second_order(settings(5.0, Thermostat::NoseHooverChain(NoseHooverChain::new(100.0, 100.0, 3))), 1e-4);
}

/// With a chain, and without one at constant enthalpy. The stress makes work, which is counted.
#[test]
fn enthalpy_is_conserved_to_second_order() {
    for thermostat in [chain(), Thermostat::None] {
        for cell in FREEDOMS {
            let settings = settings(5.0, thermostat.clone());
            is_second_order(with_barostat(settings, &fast_cell(cell), 60.0, &argon_crystal(2)), 3e-4);
        }
    }
}

/// The heat of velocity rescaling is exactly what it changes.
#[test]
fn velocity_rescaling_conserves_energy_less_its_heat() {
    let rescaling = VelocityRescaling { temperature: 100.0, relaxation_time: 100.0, heat: 0.0 };
    let settings = settings(2.0, Thermostat::VelocityRescaling(rescaling));
    let (mut dynamics, mut potential) = warm_argon(2, 80.0, settings, 300);
    let start = dynamics.conserved_energy().unwrap();
    let before = dynamics.kinetic_energy() + dynamics.evaluation().energy();
    (0..2000).for_each(|_| dynamics.step(&mut potential).unwrap());
    let change = dynamics.kinetic_energy() + dynamics.evaluation().energy() - before;
    let conserved = dynamics.conserved_energy().unwrap() - start;
    assert!(change.abs() > 0.02 && conserved.abs() < 2e-3 * change.abs(), "{conserved} eV of {change} eV");
}

#[test]
fn momentum_is_conserved() {
    let rescaling = VelocityRescaling { temperature: 60.0, relaxation_time: 100.0, heat: 0.0 };
    for thermostat in [Thermostat::None, chain(), Thermostat::VelocityRescaling(rescaling)] {
        let settings = settings(4.0, thermostat);
        let moving =
            with_barostat(settings.clone(), &fast_cell(CellFreedom::Flexible), 60.0, &argon_crystal(2));
        for settings in [settings, moving] {
            let (dynamics, _) = warm_argon(2, 60.0, settings, 500);
            let momentum = md::momentum(&dynamics.state().velocities, dynamics.masses());
            assert!(momentum.iter().all(|p| p.abs() < 1e-11), "{momentum:?}");
        }
    }
}

/// The settings of reversible dynamics.
fn reversible() -> Vec<DynamicsSettings> {
    let fixed = [Thermostat::None, chain()].map(|thermostat| settings(4.0, thermostat));
    let moving = fixed.iter().flat_map(|settings| {
        FREEDOMS.map(|cell| with_barostat(settings.clone(), &fast_cell(cell), 60.0, &argon_crystal(2)))
    });
    fixed.iter().cloned().chain(moving).collect()
}

/// The state with all velocities reversed.
fn turned(mut checkpoint: Checkpoint) -> Checkpoint {
    let negate = |x: &mut f64| *x = -*x;
    checkpoint.state.velocities.iter_mut().flatten().for_each(negate);
    if let Thermostat::NoseHooverChain(chain) = &mut checkpoint.thermostat {
        chain.velocities.iter_mut().for_each(negate);
    }
    if let CellMotion::Barostat(barostat) = &mut checkpoint.cell_motion {
        barostat.strain_rate.iter_mut().flatten().for_each(negate);
        if let CellThermostat::NoseHooverChain(chain) = &mut barostat.thermostat {
            chain.velocities.iter_mut().for_each(negate);
        }
    }
    checkpoint
}

#[test]
fn reversed_velocities_lead_back() {
    for settings in reversible() {
        let (start, mut potential) = warm_argon(2, 60.0, settings, 100);
        let mut forward = start.clone();
        (0..200).for_each(|_| forward.step(&mut potential).unwrap());
        let mut back = Dynamics::resume(turned(forward.checkpoint().clone()), 7.0, 0.6).unwrap();
        (0..200).for_each(|_| back.step(&mut potential).unwrap());
        let pairs = start.structure().positions.iter().zip(&back.structure().positions);
        let error = pairs.map(|(a, b)| atoms::cell::norm(atoms::cell::sub(*a, *b))).fold(0.0, f64::max);
        let moved = forward.structure().positions.iter().zip(&start.structure().positions);
        let way = moved.map(|(a, b)| atoms::cell::norm(atoms::cell::sub(*a, *b))).fold(0.0, f64::max);
        assert!(error < 1e-9 && way > 0.1, "{error} Å off after a way of {way} Å");
        let cells = start.structure().cell.0.iter().flatten().zip(back.structure().cell.0.iter().flatten());
        assert!(cells.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max) < 1e-10);
        if let (Some(barostat), Some(other)) = (start.barostat(), back.barostat()) {
            assert!((barostat.work - other.work).abs() < 1e-10);
        }
    }
}

/// Velocities do not change as the cell grows, so the energy changes by dE = −Σ_kk virial_kk dε only.
#[test]
fn expansion_changes_the_energy_by_the_work_of_the_virial() {
    let (start, mut potential) = warm_argon(2, 20.0, settings(1.0, Thermostat::None), 300);
    let mut checkpoint = start.checkpoint().clone();
    checkpoint.cell_motion = VolumeRamp::new(&checkpoint.state, 1.0, 1.05, 1000).into();
    let mut dynamics = Dynamics::resume(checkpoint, 7.0, 0.6).unwrap();
    let trace = |d: &Dynamics| (0..3).map(|k| d.evaluation().virial[k][k]).sum::<f64>();
    let before = dynamics.conserved_energy().unwrap();
    let mut work = 0.0;
    for _ in 0..1000 {
        let (volume, virial) = (dynamics.structure().cell.volume(), trace(&dynamics));
        dynamics.step(&mut potential).unwrap();
        let strain = (dynamics.structure().cell.volume() / volume).ln() / 3.0;
        work -= 0.5 * (virial + trace(&dynamics)) * strain;
    }
    let change = dynamics.conserved_energy().unwrap() - before;
    assert!((dynamics.structure().cell.volume() / start.structure().cell.volume() - 1.05).abs() < 1e-12);
    assert!(change.abs() > 0.01 && (change / work - 1.0).abs() < 0.01, "{change} eV for a work of {work} eV");
}
