//! Positions and velocities, with kinetic energy and temperature.

use atoms::cell::{add, dot, scale, sub};
use atoms::units::{ACCELERATION, BOLTZMANN};
use atoms::{Matrix3, Species, Structure, Vec3};
use serde::{Deserialize, Serialize};

use crate::random::{Stream, StreamId};

/// A point in phase space.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct State {
    /// Species, positions (never wrapped), cell.
    pub structure: Structure,
    /// Velocities, `[n]`, Å/fs.
    pub velocities: Vec<Vec3>,
    /// Number of completed steps.
    pub step: u64,
}

impl State {
    /// `structure` with Maxwell–Boltzmann velocities at `temperature` (K), at step 0.
    pub fn thermal(structure: Structure, temperature: f64, stream: &Stream) -> Self {
        let velocities = maxwell_boltzmann(&structure.species, temperature, stream);
        Self { structure, velocities, step: 0 }
    }
}

/// Standard atomic weights, `[n]`, u.
pub fn masses(species: &[Species]) -> Vec<f64> {
    species.iter().map(|species| species.mass()).collect()
}

/// K = ½ Σ m v², eV. `velocities` in Å/fs, `masses` in u.
pub fn kinetic_energy(velocities: &[Vec3], masses: &[f64]) -> f64 {
    velocities.iter().zip(masses).map(|(v, m)| m * dot(*v, *v)).sum::<f64>() / (2.0 * ACCELERATION)
}

/// Σ m vᵀ v, eV. `velocities` in Å/fs, `masses` in u.
pub fn kinetic_tensor(velocities: &[Vec3], masses: &[f64]) -> Matrix3 {
    let mut sum = [[0.0; 3]; 3];
    for (v, mass) in velocities.iter().zip(masses) {
        for (row, x) in sum.iter_mut().zip(v) {
            *row = add(*row, scale(*v, mass * x));
        }
    }
    sum.map(|row| row.map(|x| x / ACCELERATION))
}

/// P = Σ m v, u Å/fs.
pub fn momentum(velocities: &[Vec3], masses: &[f64]) -> Vec3 {
    velocities.iter().zip(masses).fold([0.0; 3], |p, (v, m)| add(p, scale(*v, *m)))
}

/// ½ g k_B T, eV: the mean kinetic energy of g degrees of freedom.
pub fn thermal_energy(temperature: f64, degrees_of_freedom: usize) -> f64 {
    0.5 * degrees_of_freedom as f64 * BOLTZMANN * temperature
}

/// T = 2 K / (g k_B), K, for g degrees of freedom; 0 when there are none.
pub fn temperature(kinetic_energy: f64, degrees_of_freedom: usize) -> f64 {
    if degrees_of_freedom == 0 {
        return 0.0;
    }
    2.0 * kinetic_energy / (degrees_of_freedom as f64 * BOLTZMANN)
}

/// Velocities (Å/fs) from the Maxwell–Boltzmann distribution at `temperature` (K), without centre-of-mass
/// motion and scaled to exactly that temperature with 3n − 3 degrees of freedom.
///
/// A single atom is at rest.
pub fn maxwell_boltzmann(species: &[Species], temperature: f64, stream: &Stream) -> Vec<Vec3> {
    let masses = masses(species);
    let mut velocities: Vec<Vec3> = masses
        .iter()
        .enumerate()
        .map(|(atom, mass)| {
            let width = (BOLTZMANN * temperature * ACCELERATION / mass).sqrt();
            scale(stream.normals(0, atom as u32, StreamId::InitialVelocities), width)
        })
        .collect();
    let drift = scale(momentum(&velocities, &masses), 1.0 / masses.iter().sum::<f64>());
    velocities.iter_mut().for_each(|v| *v = sub(*v, drift));

    let degrees_of_freedom = 3 * species.len().saturating_sub(1);
    let present = self::temperature(kinetic_energy(&velocities, &masses), degrees_of_freedom);
    let factor = if present > 0.0 { (temperature / present).sqrt() } else { 0.0 };
    velocities.iter_mut().for_each(|v| *v = scale(*v, factor));
    velocities
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thermal_velocities_have_the_temperature_no_drift_and_equipartition() {
        let species: Vec<Species> =
            ["H", "W"].iter().cycle().take(4000).map(|s| s.parse().unwrap()).collect();
        let velocities = maxwell_boltzmann(&species, 750.0, &Stream::new(7, 0, 0));
        let masses = masses(&species);
        let energy = kinetic_energy(&velocities, &masses);
        assert!((temperature(energy, 3 * 3999) - 750.0).abs() < 1e-9);
        assert!(momentum(&velocities, &masses).iter().all(|p| p.abs() < 1e-9));
        // Each element has half of the energy; a sum of 6000 squares fluctuates by √(2/6000).
        let hydrogen: f64 =
            (0..4000).step_by(2).map(|i| kinetic_energy(&velocities[i..=i], &masses[i..=i])).sum();
        assert!((2.0 * hydrogen / energy - 1.0).abs() < 5.0 * f64::sqrt(2.0 / 6000.0));
    }

    #[test]
    fn kinetic_energy_is_in_electron_volts() {
        // 1 u at 1 Å/fs = 10⁵ m/s: ½ · 1.66053907e-27 kg · 10¹⁰ m²/s² / 1.602176634e-19 J.
        let expected = 0.5 * 1.660_539_066_60e-27 * 1e10 / 1.602_176_634e-19;
        assert!((kinetic_energy(&[[0.6, 0.0, -0.8]], &[1.0]) / expected - 1.0).abs() < 1e-9);
    }

    #[test]
    fn one_atom_or_no_temperature_means_rest() {
        let species: Vec<Species> = vec!["Al".parse().unwrap(); 3];
        let stream = Stream::new(1, 1, 1);
        assert_eq!(maxwell_boltzmann(&species[..1], 300.0, &stream), [[0.0; 3]]);
        assert_eq!(maxwell_boltzmann(&species, 0.0, &stream), [[0.0; 3]; 3]);
    }
}
