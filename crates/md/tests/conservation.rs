//! Properties that an integrator must conserve: energy to second order, momentum, and time reversal.

use md::{Checkpoint, Dynamics, NoseHooverChain, Thermostat, VolumeRamp};

use crate::common::{LennardJones, settings, warm_argon};

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

fn is_second_order(thermostat: Thermostat) {
    let (dynamics, _) = warm_argon(2, 80.0, settings(5.0, thermostat), 300);
    let [coarse, middle, fine] = [8.0, 4.0, 2.0].map(|dt| fluctuation(dynamics.checkpoint(), dt));
    let kinetic = dynamics.kinetic_energy();
    assert!(fine < 1e-4 * kinetic, "fluctuation {fine} eV of {kinetic} eV");
    for ratio in [coarse / middle, middle / fine] {
        assert!((ratio - 4.0).abs() < 0.4, "halving the time step divides the error by {ratio}");
    }
}

#[test]
fn constant_energy_is_conserved_to_second_order() {
    is_second_order(Thermostat::None);
}

#[test]
fn nose_hoover_energy_is_conserved_to_second_order() {
    is_second_order(Thermostat::NoseHooverChain(NoseHooverChain::new(100.0, 100.0, 3)));
}

#[test]
fn momentum_is_conserved() {
    for thermostat in [Thermostat::None, Thermostat::NoseHooverChain(NoseHooverChain::new(60.0, 100.0, 4))] {
        let (dynamics, _) = warm_argon(2, 60.0, settings(4.0, thermostat), 500);
        let momentum = md::momentum(&dynamics.state().velocities, dynamics.masses());
        assert!(momentum.iter().all(|p| p.abs() < 1e-11), "{momentum:?}");
    }
}

#[test]
fn reversed_velocities_lead_back() {
    for thermostat in [Thermostat::None, Thermostat::NoseHooverChain(NoseHooverChain::new(60.0, 100.0, 3))] {
        let (start, mut potential) = warm_argon(2, 60.0, settings(4.0, thermostat), 100);
        let mut forward = start.clone();
        (0..200).for_each(|_| forward.step(&mut potential).unwrap());
        let mut turned = forward.checkpoint().clone();
        turned.state.velocities.iter_mut().flatten().for_each(|v| *v = -*v);
        if let Thermostat::NoseHooverChain(chain) = &mut turned.thermostat {
            chain.velocities.iter_mut().for_each(|v| *v = -*v);
        }
        let mut back = Dynamics::resume(turned, 7.0, 0.6).unwrap();
        (0..200).for_each(|_| back.step(&mut potential).unwrap());
        let pairs = start.structure().positions.iter().zip(&back.structure().positions);
        let error = pairs.map(|(a, b)| atoms::cell::norm(atoms::cell::sub(*a, *b))).fold(0.0, f64::max);
        let moved = forward.structure().positions.iter().zip(&start.structure().positions);
        let way = moved.map(|(a, b)| atoms::cell::norm(atoms::cell::sub(*a, *b))).fold(0.0, f64::max);
        assert!(error < 1e-9 && way > 0.1, "{error} Å off after a way of {way} Å");
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
