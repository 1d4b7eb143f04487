//! Barostats against the isothermal–isobaric distribution, within five standard errors.

use atoms::units::BOLTZMANN;
use md::{
    BAR_PER_EV_A3, BarostatSettings, CellFreedom, Dynamics, Langevin, NoseHooverChain, State, Thermostat,
    VelocityRescaling,
};

use crate::common::{
    IdealGas, LennardJones, argon_crystal, crystal, log_odds_slope, mean_and_variance, settings, warm_argon,
    with_barostat,
};

fn within_five_errors(what: &str, [found, error]: [f64; 2], expected: f64, scale: f64) {
    assert!(error < scale, "{what}: too few samples, {found} ± {error}");
    assert!((found - expected).abs() < 5.0 * error, "{what}: {found} ± {error}, expected {expected}");
}

fn langevin(temperature: f64) -> Thermostat {
    Thermostat::Langevin(Langevin { temperature, friction: 0.01 })
}

fn rescaling(temperature: f64) -> Thermostat {
    Thermostat::VelocityRescaling(VelocityRescaling { temperature, relaxation_time: 50.0, heat: 0.0 })
}

fn chain(temperature: f64) -> Thermostat {
    Thermostat::NoseHooverChain(NoseHooverChain::new(temperature, 200.0, 3))
}

/// p(V) ∝ V^N e^(−PV/kT) where each atom moves freely (Langevin), and ∝ V^(N−1) e^(−PV/kT) where the centre of mass is
/// at rest: N − 1 positions relative to it remain. In units of kT/P these are the Gamma laws of shape N + 1 and N.
/// `quartiles` of that law.
fn volume_of_an_ideal_gas(thermostat: Thermostat, shape: f64, quartiles: [f64; 3]) {
    let (temperature, pressure) = (300.0, 300.0);
    let unit = BOLTZMANN * temperature * BAR_PER_EV_A3 / pressure;
    let mut structure = crystal("Ar", 1.0, 2);
    structure.species.truncate(12);
    structure.positions.truncate(12);
    let start = structure.cell.volume();
    md::scale_volume(&mut structure, 9.0 * unit / start);
    let barostat = BarostatSettings {
        pressure,
        cell: CellFreedom::Isotropic,
        relaxation_time: 100.0,
        ..Default::default()
    };
    let settings = with_barostat(settings(4.0, thermostat), &barostat, temperature, &structure);
    let state = State::thermal(structure, temperature, &settings.stream);
    let mut gas = IdealGas::argon();
    let mut dynamics = Dynamics::new(state, settings, &mut gas).unwrap();
    // A gas of so few atoms reaches volumes that no material has.
    dynamics.set_volume_range(Some([0.01 * unit, 100.0 * unit])).unwrap();
    let volumes: Vec<f64> = (0..300_000)
        .map(|_| {
            dynamics.step(&mut gas).unwrap();
            dynamics.structure().cell.volume() / unit
        })
        .collect();
    let (mean, variance) = mean_and_variance(&volumes, 100);
    within_five_errors("mean", mean, shape, 0.2);
    within_five_errors("variance", variance, shape, 0.08 * shape);
    for (quartile, expected) in quartiles.into_iter().zip([0.25, 0.5, 0.75]) {
        let below: Vec<f64> = volumes.iter().map(|v| f64::from(*v < quartile)).collect();
        within_five_errors("share below a quartile", mean_and_variance(&below, 100).0, expected, 0.02);
    }
}

/// Quartiles of the Gamma law of shape 12 and 13 (`scipy.stats.gamma(n).ppf`).
const GAMMA_12: [f64; 3] = [9.518_626_264_761_775, 11.668_363_153_044_767, 14.120_575_012_764_382];
const GAMMA_13: [f64; 3] = [10.421_715_551_537_71, 12.668_229_058_738_632, 15.217_282_714_307_908];

#[test]
fn ideal_gas_at_rest_follows_the_gamma_law() {
    volume_of_an_ideal_gas(rescaling(300.0), 12.0, GAMMA_12);
}

#[test]
fn ideal_gas_of_free_atoms_follows_the_gamma_law() {
    volume_of_an_ideal_gas(langevin(300.0), 13.0, GAMMA_13);
}

/// Argon under a pressure and a stress, solid at 20 K and liquid at 60 K: mean stress inside, kinetic energies of atoms and cell.
fn argon_under_stress(temperature: f64, thermostat: Thermostat, barostat: BarostatSettings) {
    let settings = with_barostat(settings(4.0, thermostat), &barostat, temperature, &argon_crystal(2));
    let (mut dynamics, mut potential) = warm_argon(2, temperature, settings, 4000);
    let mut series = vec![Vec::new(); 8];
    for _ in 0..30_000 {
        dynamics.step(&mut potential).unwrap();
        let p = dynamics.pressure_tensor().unwrap().map(|row| row.map(|x| x * BAR_PER_EV_A3));
        let cell = dynamics.barostat().unwrap();
        let cell_energy = cell.kinetic_energy(dynamics.structure(), dynamics.degrees_of_freedom());
        let values =
            [p[0][0], p[1][1], p[2][2], p[1][2], p[0][2], p[0][1], cell_energy, dynamics.kinetic_energy()];
        series.iter_mut().zip(values).for_each(|(series, value)| series.push(value));
    }
    let (pressure, stress) = (barostat.pressure, barostat.stress);
    let tensor = |k: usize| mean_and_variance(&series[k], 50).0;
    if barostat.cell == CellFreedom::Flexible {
        for (k, stress) in stress.iter().enumerate() {
            let expected = if k < 3 { pressure - stress } else { -stress };
            within_five_errors("component of the pressure", tensor(k), expected, 30.0);
        }
    }
    let trace: Vec<f64> = (0..series[0].len()).map(|t| (0..3).map(|k| series[k][t] / 3.0).sum()).collect();
    let hydrostatic = pressure - (stress[0] + stress[1] + stress[2]) / 3.0;
    within_five_errors("pressure", mean_and_variance(&trace, 50).0, hydrostatic, 20.0);
    let thermal = BOLTZMANN * temperature;
    let cell_freedom = dynamics.barostat().unwrap().degrees_of_freedom(dynamics.structure()) as f64;
    for (what, series, freedom) in
        [("cell", &series[6], cell_freedom), ("atoms", &series[7], dynamics.degrees_of_freedom() as f64)]
    {
        let (mean, variance) = mean_and_variance(series, 50);
        within_five_errors(what, mean, 0.5 * freedom * thermal, 0.1 * freedom * thermal);
        within_five_errors(
            what,
            variance,
            0.5 * freedom * thermal * thermal,
            0.25 * freedom * thermal * thermal,
        );
    }
}

/// A shear that the crystal withstands.
const SHEARED: BarostatSettings = BarostatSettings {
    pressure: 300.0,
    stress: [150.0, 0.0, -60.0, 80.0, 0.0, -120.0],
    cell: CellFreedom::Flexible,
    relaxation_time: 400.0,
};

const COMPRESSED: BarostatSettings = BarostatSettings { stress: [0.0; 6], ..SHEARED };

#[test]
fn chains_keep_the_set_stress() {
    argon_under_stress(20.0, chain(20.0), SHEARED);
}

#[test]
fn velocity_rescaling_keeps_the_set_stress() {
    argon_under_stress(20.0, rescaling(20.0), SHEARED);
}

#[test]
fn langevin_keeps_the_set_stress() {
    argon_under_stress(20.0, langevin(20.0), SHEARED);
}

#[test]
fn a_liquid_keeps_the_pressure() {
    argon_under_stress(60.0, chain(60.0), COMPRESSED);
}

#[test]
fn cells_of_one_shape_keep_the_pressure() {
    for cell in [CellFreedom::Isotropic, CellFreedom::FixedAngles] {
        argon_under_stress(20.0, rescaling(20.0), BarostatSettings { cell, ..COMPRESSED });
    }
}

/// The histograms of the volume at two pressures have the ratio ln(p₁/p₂) = β (P₂ − P₁) V + constant, for each kind of
/// cell and thermostat.
#[test]
fn volumes_at_two_pressures_have_the_boltzmann_ratio() {
    let (temperature, pressures) = (20.0, [100.0, 250.0]);
    let cases = [
        (chain as fn(f64) -> Thermostat, CellFreedom::Flexible),
        (rescaling, CellFreedom::Isotropic),
        (langevin, CellFreedom::FixedAngles),
    ];
    for (thermostat, cell) in cases {
        let [first, second] = pressures.map(|pressure| {
            let barostat = BarostatSettings { pressure, cell, ..COMPRESSED };
            let settings = with_barostat(
                settings(4.0, thermostat(temperature)),
                &barostat,
                temperature,
                &argon_crystal(2),
            );
            let (mut dynamics, mut potential) = warm_argon(2, temperature, settings, 2000);
            let volumes = (0..12_000).map(|_| {
                dynamics.step(&mut potential).unwrap();
                dynamics.structure().cell.volume()
            });
            volumes.collect::<Vec<f64>>()
        });
        let expected = (pressures[1] - pressures[0]) / BAR_PER_EV_A3 / (BOLTZMANN * temperature);
        let [slope, error] = log_odds_slope(&first, &second, 20);
        assert!(error < 0.15 * expected, "{slope} ± {error} 1/Å³");
        assert!((slope - expected).abs() < 5.0 * error, "{slope} ± {error} 1/Å³, expected {expected}");
    }
}

/// B = V d²E/dV² is −V dP/dV without motion.
#[test]
fn the_bulk_modulus_is_the_derivative_of_the_pressure() {
    let mut potential = LennardJones::argon();
    let crystal = argon_crystal(3);
    let pressures = [0.999, 1.001].map(|ratio| {
        let mut structure = crystal.clone();
        md::scale_volume(&mut structure, ratio);
        let at_rest = State { velocities: vec![[0.0; 3]; structure.len()], structure, step: 0 };
        let tensor = Dynamics::new(at_rest, settings(4.0, Thermostat::None), &mut potential)
            .unwrap()
            .pressure_tensor();
        tensor.unwrap()[0][0]
    });
    let expected = (pressures[0] - pressures[1]) / 0.002;
    let found = md::bulk_modulus(&crystal, &mut potential).unwrap();
    assert!((found / expected - 1.0).abs() < 0.01, "{found} eV/Å³, from the pressure {expected}");
}

/// The isothermal bulk modulus from the fluctuations of the volume, k_B T ⟨V⟩ / ⟨(V − ⟨V⟩)²⟩, is that of the mean
/// pressure at constant volume, −V d⟨P⟩/dV.
#[test]
fn fluctuations_of_the_volume_give_the_bulk_modulus() {
    let temperature = 20.0;
    let barostat = BarostatSettings { cell: CellFreedom::Isotropic, relaxation_time: 100.0, ..COMPRESSED };
    let fixed = settings(4.0, rescaling(temperature));
    let moving = with_barostat(fixed.clone(), &barostat, temperature, &argon_crystal(2));
    let (mut dynamics, mut potential) = warm_argon(2, temperature, moving, 4000);
    let volumes: Vec<f64> = (0..40_000)
        .map(|_| {
            dynamics.step(&mut potential).unwrap();
            dynamics.structure().cell.volume()
        })
        .collect();
    let ([volume, _], [variance, error]) = mean_and_variance(&volumes, 50);
    let from_fluctuations = BOLTZMANN * temperature * volume / variance;
    let error = from_fluctuations * error / variance;

    let pressures = [0.98, 1.02].map(|ratio| {
        let mut state = dynamics.state().clone();
        let present = state.structure.cell.volume();
        md::scale_volume(&mut state.structure, ratio * volume / present);
        let mut dynamics = Dynamics::new(state, fixed.clone(), &mut potential).unwrap();
        let series: Vec<f64> = (0..10_000)
            .map(|_| {
                dynamics.step(&mut potential).unwrap();
                let tensor = dynamics.pressure_tensor().unwrap();
                (tensor[0][0] + tensor[1][1] + tensor[2][2]) / 3.0
            })
            .collect();
        mean_and_variance(&series[1000..], 20).0
    });
    let slope = (pressures[0][0] - pressures[1][0]) / 0.04;
    let error = error.hypot(pressures[0][1].hypot(pressures[1][1]) / 0.04);
    assert!(error < 0.1 * slope, "{from_fluctuations} ± {error} eV/Å³");
    assert!(
        (from_fluctuations - slope).abs() < 5.0 * error,
        "{from_fluctuations} ± {error} eV/Å³, from the pressure {slope}"
    );
}
