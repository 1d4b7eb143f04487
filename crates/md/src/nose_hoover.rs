//! The Nosé–Hoover chain.

use atoms::units::BOLTZMANN;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::wrong_setting::{WrongSetting, is_positive};

/// Weights of the fourth-order Suzuki–Yoshida factorisation, w = 1 / (2 − 2^(1/3)).
const SUZUKI_YOSHIDA: [f64; 3] = [1.351_207_191_959_657_8, -1.702_414_383_919_315_3, 1.351_207_191_959_657_8];

/// Settings of a Nosé–Hoover chain.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NoseHooverSettings {
    /// Relaxation time, fs.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub relaxation_time: f64,
    /// Number of thermostats in the chain.
    #[serde(default = "usual_length")]
    pub chain_length: usize,
}

fn usual_length() -> usize {
    NoseHooverChain::LENGTH
}

impl NoseHooverSettings {
    pub(crate) fn start(self, temperature: f64) -> NoseHooverChain {
        NoseHooverChain::new(temperature, self.relaxation_time, self.chain_length)
    }

    pub(crate) fn wrong(&self) -> Option<WrongSetting> {
        WrongSetting::unless_positive("nose_hoover.relaxation_time", self.relaxation_time)
    }
}

/// A chain of thermostats: the first acts on the atoms, each other on its predecessor.
///
/// Masses Q₁ = g k_B T t², Q_k = k_B T t² with the damping time t and g degrees of freedom (Martyna, Klein &
/// Tuckerman, J. Chem. Phys. 97, 2635 (1992)).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NoseHooverChain {
    /// Temperature, K.
    pub temperature: f64,
    /// Damping time t, fs.
    pub damping_time: f64,
    /// Thermostat positions η, dimensionless.
    pub positions: Vec<f64>,
    /// Thermostat velocities dη/dt, 1/fs.
    pub velocities: Vec<f64>,
}

impl NoseHooverChain {
    /// The usual length of a chain.
    pub const LENGTH: usize = 3;

    /// A chain at rest. `temperature` in K, `damping_time` in fs.
    pub fn new(temperature: f64, damping_time: f64, length: usize) -> Self {
        Self { temperature, damping_time, positions: vec![0.0; length], velocities: vec![0.0; length] }
    }

    /// Propagates the chain by half of `time_step` (fs). Returns the factor for the atoms' velocities.
    ///
    /// `kinetic_energy` of the atoms in eV. Uses the symmetric factorisation of Martyna, Tuckerman, Tobias &
    /// Klein, Mol. Phys. 87, 1117 (1996), with the Suzuki–Yoshida weights above.
    pub fn half_step(&mut self, kinetic_energy: f64, degrees_of_freedom: usize, time_step: f64) -> f64 {
        let mut factor = 1.0;
        for weight in SUZUKI_YOSHIDA {
            let half = 0.5 * weight * time_step;
            self.kick_from_the_end(kinetic_energy * factor * factor, degrees_of_freedom, half);
            factor *= (-half * self.velocities[0]).exp();
            for (position, velocity) in self.positions.iter_mut().zip(&self.velocities) {
                *position += half * velocity;
            }
            self.kick_from_the_start(kinetic_energy * factor * factor, degrees_of_freedom, half);
        }
        factor
    }

    /// The energy of the chain, eV: Σ ½ Q_k (dη_k/dt)² + g k_B T η₁ + k_B T Σ_{k≥2} η_k. Part of the conserved
    /// energy.
    pub fn energy(&self, degrees_of_freedom: usize) -> f64 {
        let thermal = BOLTZMANN * self.temperature;
        let positions = self.positions.iter().zip(&self.velocities).enumerate();
        positions
            .map(|(k, (position, velocity))| {
                let freedom = if k == 0 { degrees_of_freedom as f64 } else { 1.0 };
                0.5 * self.mass(k, degrees_of_freedom) * velocity * velocity + freedom * thermal * position
            })
            .sum()
    }

    pub(crate) fn invalid_setting(&self, atoms: usize) -> Option<&'static str> {
        if atoms < 2 {
            return Some("a Nosé–Hoover chain needs at least two atoms: a single one has no thermal motion");
        }
        if !is_positive(self.temperature) || !is_positive(self.damping_time) {
            return Some("temperature and damping time of the Nosé–Hoover chain must be positive and finite");
        }
        let valid = !self.velocities.is_empty() && self.positions.len() == self.velocities.len();
        (!valid).then_some("a Nosé–Hoover chain needs one or more links, each with a position and a velocity")
    }

    fn kick_from_the_end(&mut self, kinetic_energy: f64, degrees_of_freedom: usize, time: f64) {
        for k in (0..self.velocities.len()).rev() {
            self.kick(k, kinetic_energy, degrees_of_freedom, time);
        }
    }

    fn kick_from_the_start(&mut self, kinetic_energy: f64, degrees_of_freedom: usize, time: f64) {
        for k in 0..self.velocities.len() {
            self.kick(k, kinetic_energy, degrees_of_freedom, time);
        }
    }

    /// Advances the velocity of link `k` by half of `time`: friction from the next link around the force G_k.
    fn kick(&mut self, k: usize, kinetic_energy: f64, degrees_of_freedom: usize, time: f64) {
        let friction = self.velocities.get(k + 1).map_or(1.0, |next| (-0.25 * time * next).exp());
        let acceleration =
            self.force(k, kinetic_energy, degrees_of_freedom) / self.mass(k, degrees_of_freedom);
        let velocity = &mut self.velocities[k];
        *velocity = (*velocity * friction + 0.5 * time * acceleration) * friction;
    }

    /// G₁ = 2K − g k_B T, G_k = Q_{k−1} (dη_{k−1}/dt)² − k_B T, eV.
    fn force(&self, k: usize, kinetic_energy: f64, degrees_of_freedom: usize) -> f64 {
        let thermal = BOLTZMANN * self.temperature;
        if k == 0 {
            return 2.0 * kinetic_energy - degrees_of_freedom as f64 * thermal;
        }
        self.mass(k - 1, degrees_of_freedom) * self.velocities[k - 1] * self.velocities[k - 1] - thermal
    }

    /// Q_k, eV fs².
    fn mass(&self, k: usize, degrees_of_freedom: usize) -> f64 {
        let freedom = if k == 0 { degrees_of_freedom as f64 } else { 1.0 };
        freedom * BOLTZMANN * self.temperature * self.damping_time * self.damping_time
    }
}
