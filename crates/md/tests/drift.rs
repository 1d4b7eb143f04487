//! Long-time drift of the conserved quantity at 1 fs, with an embedded-atom potential and with GRACE.

use std::sync::Arc;

use atoms::Potential;
use md::{BarostatSettings, Dynamics, DynamicsSettings, NoseHooverChain, State, Thermostat};
use potentials::grace::{Grace, GraceModel};

use crate::common::{aluminium, crystal, settings, with_barostat};

/// Slope of the conserved quantity of 32 atoms at 300 K, eV per atom and ps, and its standard error, from ten pieces of
/// a run of `steps` steps.
fn drift(potential: &mut dyn Potential, settings: DynamicsSettings, steps: usize) -> [f64; 2] {
    let structure = crystal("Al", 4.05, 2);
    let atoms = structure.len() as f64;
    let state = State::thermal(structure, 600.0, &settings.stream);
    let mut dynamics = Dynamics::new(state, settings, potential).unwrap();
    (0..steps / 20).for_each(|_| dynamics.step(potential).unwrap());
    let length = steps / 10;
    let pieces: Vec<f64> = (0..10)
        .map(|_| {
            let energies = (0..length).map(|_| {
                dynamics.step(potential).unwrap();
                dynamics.conserved_energy().unwrap() / atoms
            });
            energies.sum::<f64>() / length as f64
        })
        .collect();
    let time = |k: usize| 1e-3 * length as f64 * (k as f64 - 4.5);
    let mean = pieces.iter().sum::<f64>() / 10.0;
    let spread: f64 = (0..10).map(|k| time(k).powi(2)).sum();
    let slope = pieces.iter().enumerate().map(|(k, e)| time(k) * (e - mean)).sum::<f64>() / spread;
    let scatter: f64 = pieces.iter().enumerate().map(|(k, e)| (e - mean - slope * time(k)).powi(2)).sum();
    [slope, (scatter / 8.0 / spread).sqrt()]
}

/// Constant energy, constant temperature and constant pressure.
fn ensembles() -> [DynamicsSettings; 3] {
    let fixed = settings(1.0, Thermostat::NoseHooverChain(NoseHooverChain::new(300.0, 100.0, 3)));
    let moving = with_barostat(fixed.clone(), &BarostatSettings::default(), 300.0, &crystal("Al", 4.05, 2));
    [settings(1.0, Thermostat::None), fixed, moving]
}

fn does_not_drift(potential: &mut dyn Potential, settings: DynamicsSettings, steps: usize) {
    let [slope, error] = drift(potential, settings.clone(), steps);
    assert!(slope.abs() < 1e-6 && error < 1e-6, "{slope} ± {error} eV per atom and ps, {settings:?}");
}

#[test]
fn conserved_quantities_do_not_drift() {
    let mut potential = aluminium();
    ensembles().into_iter().for_each(|settings| does_not_drift(&mut potential, settings, 20_000));
}

#[test]
fn conserved_quantities_do_not_drift_with_grace() {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/data/al_eam_1l/kokkos.npz");
    let mut potential = Grace::new(Arc::new(GraceModel::load(file.as_ref()).unwrap()));
    ensembles().into_iter().for_each(|settings| does_not_drift(&mut potential, settings, 3000));
}
