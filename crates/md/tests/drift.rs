//! Long-time drift of the conserved quantity with an embedded-atom potential at 1 fs.

use md::{BarostatSettings, Dynamics, DynamicsSettings, NoseHooverChain, State, Thermostat};

use crate::common::{aluminium, crystal, settings, with_barostat};

/// Slope of the conserved quantity over 20 ps, eV per atom and ps, and its standard error from ten pieces of the run.
fn drift(settings: DynamicsSettings) -> [f64; 2] {
    let structure = crystal("Al", 4.05, 2);
    let (atoms, mut potential) = (structure.len() as f64, aluminium());
    let state = State::thermal(structure, 600.0, &settings.stream);
    let mut dynamics = Dynamics::new(state, settings, &mut potential).unwrap();
    (0..1000).for_each(|_| dynamics.step(&mut potential).unwrap());
    let pieces: Vec<f64> = (0..10)
        .map(|_| {
            let steps = (0..2000).map(|_| {
                dynamics.step(&mut potential).unwrap();
                dynamics.conserved_energy().unwrap() / atoms
            });
            steps.sum::<f64>() / 2000.0
        })
        .collect();
    let time = |k: usize| 2.0 * (k as f64 - 4.5);
    let mean = pieces.iter().sum::<f64>() / 10.0;
    let spread: f64 = (0..10).map(|k| time(k).powi(2)).sum();
    let slope = pieces.iter().enumerate().map(|(k, e)| time(k) * (e - mean)).sum::<f64>() / spread;
    let scatter: f64 = pieces.iter().enumerate().map(|(k, e)| (e - mean - slope * time(k)).powi(2)).sum();
    [slope, (scatter / 8.0 / spread).sqrt()]
}

#[test]
fn conserved_quantities_do_not_drift() {
    let chain = Thermostat::NoseHooverChain(NoseHooverChain::new(300.0, 100.0, 3));
    let fixed = settings(1.0, chain);
    let moving = with_barostat(fixed.clone(), &BarostatSettings::default(), 300.0, &crystal("Al", 4.05, 2));
    for settings in [settings(1.0, Thermostat::None), fixed, moving] {
        let [slope, error] = drift(settings.clone());
        assert!(
            slope.abs() < 1e-6 && error < 1e-6,
            "{slope} ± {error} eV per atom and ps, {:?}",
            settings.cell_motion
        );
    }
}
