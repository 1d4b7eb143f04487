//! Thermostats against the canonical distribution: mean and width, within five standard errors.

use atoms::units::{ACCELERATION, BOLTZMANN};
use md::{Dynamics, Langevin, NoseHooverChain, State, Thermostat, VelocityRescaling};

use crate::common::{Springs, argon_crystal, log_odds_slope, mean_and_variance, settings, warm_argon};

fn within_five_errors(what: &str, [found, error]: [f64; 2], expected: f64) {
    assert!(error < 0.1 * expected, "{what}: too few samples, {found} ± {error}");
    assert!((found - expected).abs() < 5.0 * error, "{what}: {found} ± {error}, expected {expected}");
}

/// Quartiles of the Gamma laws of shape 93/2 and 96/2 (`scipy.stats.gamma(n).ppf`).
const AT_REST: [f64; 3] = [41.73723129570833, 46.16709480560558, 50.90004505226711];
const FREE: [f64; 3] = [43.16334185162806, 47.66708132493373, 52.47391398204094];

/// ⟨K⟩ = g k_B T / 2 and ⟨(K − ⟨K⟩)²⟩ = g (k_B T)² / 2; K / k_B T follows the Gamma law of shape g / 2.
fn kinetic_energy_is_canonical(temperature: f64, thermostat: Thermostat) {
    let (mut dynamics, mut potential) = warm_argon(2, temperature, settings(4.0, thermostat), 1000);
    let series: Vec<f64> = (0..40_000)
        .map(|_| {
            dynamics.step(&mut potential).unwrap();
            dynamics.kinetic_energy()
        })
        .collect();
    let (mean, variance) = mean_and_variance(&series, 50);
    let (freedom, thermal) = (dynamics.degrees_of_freedom() as f64, BOLTZMANN * temperature);
    within_five_errors("mean", mean, 0.5 * freedom * thermal);
    within_five_errors("variance", variance, 0.5 * freedom * thermal * thermal);
    let quartiles = if freedom == 93.0 { AT_REST } else { FREE };
    for (quartile, share) in quartiles.into_iter().zip([0.25, 0.5, 0.75]) {
        let below: Vec<f64> = series.iter().map(|k| f64::from(*k < quartile * thermal)).collect();
        within_five_errors("share below a quartile", mean_and_variance(&below, 50).0, share);
    }
}

#[test]
fn langevin_kinetic_energy_is_canonical() {
    kinetic_energy_is_canonical(60.0, Thermostat::Langevin(Langevin { temperature: 60.0, friction: 0.01 }));
}

#[test]
fn nose_hoover_kinetic_energy_is_canonical() {
    kinetic_energy_is_canonical(120.0, Thermostat::NoseHooverChain(NoseHooverChain::new(120.0, 200.0, 3)));
}

fn rescaling(temperature: f64) -> Thermostat {
    Thermostat::VelocityRescaling(VelocityRescaling { temperature, relaxation_time: 100.0, heat: 0.0 })
}

#[test]
fn velocity_rescaling_kinetic_energy_is_canonical() {
    kinetic_energy_is_canonical(90.0, rescaling(90.0));
}

/// The histograms of the potential energy at two temperatures have the ratio of the Boltzmann factors, ln(p₁/p₂) = (β₂ −
/// β₁) E + constant (Shirts, J. Chem. Theory Comput. 9, 909 (2013)). All thermostats give the same mean energy.
#[test]
fn energies_at_two_temperatures_have_the_boltzmann_ratio() {
    let [cold, hot] = [60.0, 66.0];
    let thermostats: [fn(f64) -> Thermostat; 3] = [
        |temperature| Thermostat::Langevin(Langevin { temperature, friction: 0.01 }),
        |temperature| Thermostat::NoseHooverChain(NoseHooverChain::new(temperature, 200.0, 3)),
        rescaling,
    ];
    let mut means = Vec::new();
    for thermostat in thermostats {
        let [first, second] = [cold, hot].map(|temperature| {
            let settings = settings(4.0, thermostat(temperature));
            let (mut dynamics, mut potential) = warm_argon(2, temperature, settings, 1000);
            let energies = (0..12_000).map(|_| {
                dynamics.step(&mut potential).unwrap();
                dynamics.evaluation().energy()
            });
            energies.collect::<Vec<f64>>()
        });
        let expected = (1.0 / hot - 1.0 / cold) / BOLTZMANN;
        let [slope, error] = log_odds_slope(&first, &second, 20);
        assert!(error < 0.15 * expected.abs(), "{slope} ± {error} 1/eV");
        assert!((slope - expected).abs() < 5.0 * error, "{slope} ± {error} 1/eV, expected {expected}");
        means.push(mean_and_variance(&first, 20).0);
    }
    for [mean, error] in &means {
        // 1 K of the harmonic crystal.
        assert!(*error < 1.5 * 32.0 * BOLTZMANN, "{means:?}");
        for [other, its_error] in &means {
            assert!((mean - other).abs() < 5.0 * error.hypot(*its_error), "{means:?}");
        }
    }
}

/// In a harmonic well BAOAB samples positions exactly at any stable time step, ⟨x²⟩ = k_B T / k, while
/// velocities at the end of a step are too cold by 1 − (ω Δt)²/4 (Leimkuhler & Matthews, J. Chem. Phys. 138,
/// 174102 (2013)). Each oscillator is an independent sample, for any correlation time.
#[test]
fn baoab_is_exact_for_harmonic_positions() {
    let (temperature, stiffness) = (300.0, 2.0);
    let structure = argon_crystal(5);
    let mut springs = Springs::new(structure.positions.clone(), stiffness);
    let mass = structure.species[0].mass();
    let frequency = (stiffness * ACCELERATION / mass).sqrt();
    let time_step = 1.0 / frequency;
    let thermostat = Thermostat::Langevin(Langevin { temperature, friction: 0.2 * frequency });
    let settings = settings(time_step, thermostat);
    let state = State::thermal(structure, temperature, &settings.stream);
    let mut dynamics = Dynamics::new(state, settings, &mut springs).unwrap();
    (0..200).for_each(|_| dynamics.step(&mut springs).unwrap());

    let oscillators = 3 * springs.sites.len();
    let (mut positions, mut velocities) = (vec![0.0; oscillators], vec![0.0; oscillators]);
    let steps = 1000;
    for _ in 0..steps {
        dynamics.step(&mut springs).unwrap();
        let sites = springs.sites.iter().flatten();
        for (sum, (x, site)) in
            positions.iter_mut().zip(dynamics.structure().positions.iter().flatten().zip(sites))
        {
            *sum += (x - site).powi(2) / steps as f64;
        }
        for (sum, v) in velocities.iter_mut().zip(dynamics.state().velocities.iter().flatten()) {
            *sum += v * v / steps as f64;
        }
    }
    let thermal = BOLTZMANN * temperature;
    let (position, _) = mean_and_variance(&positions, oscillators);
    within_five_errors("⟨x²⟩", position, thermal / stiffness);
    assert!(position[1] < 0.01 * position[0]);
    let (velocity, _) = mean_and_variance(&velocities, oscillators);
    within_five_errors("⟨v²⟩", velocity, 0.75 * thermal * ACCELERATION / mass);
}
