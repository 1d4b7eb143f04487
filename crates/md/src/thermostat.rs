//! The choice of a thermostat. Each thermostat has its own file, with its settings and its dynamics.

use atoms::{Vec3, cell};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::langevin::{Langevin, LangevinSettings};
use crate::nose_hoover::{NoseHooverChain, NoseHooverSettings};
use crate::random::Stream;
use crate::state;
use crate::velocity_rescaling::{VelocityRescaling, VelocityRescalingSettings};
use crate::wrong_setting::WrongSetting;

/// A thermostat as a configuration names it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum ThermostatSettings {
    /// Langevin dynamics, integrated by BAOAB.
    Langevin(LangevinSettings),
    /// Nosé–Hoover chain.
    NoseHoover(NoseHooverSettings),
    /// Stochastic velocity rescaling.
    VelocityRescaling(VelocityRescalingSettings),
    /// Constant energy.
    None {},
}

impl ThermostatSettings {
    /// The thermostat in its initial state. `temperature` in K.
    pub fn start(&self, temperature: f64) -> Thermostat {
        match self {
            Self::Langevin(settings) => Thermostat::Langevin(settings.start(temperature)),
            Self::NoseHoover(settings) => Thermostat::NoseHooverChain(settings.start(temperature)),
            Self::VelocityRescaling(settings) => Thermostat::VelocityRescaling(settings.start(temperature)),
            Self::None {} => Thermostat::None,
        }
    }

    /// The first setting with an impossible value.
    pub fn wrong(&self) -> Option<WrongSetting> {
        match self {
            Self::Langevin(settings) => settings.wrong(),
            Self::NoseHoover(settings) => settings.wrong(),
            Self::VelocityRescaling(settings) => settings.wrong(),
            Self::None {} => None,
        }
    }
}

/// The thermostat with its dynamical variables.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub enum Thermostat {
    /// Constant energy.
    #[default]
    None,
    /// Friction and a random force, integrated by BAOAB.
    Langevin(Langevin),
    /// Deterministic, canonical for ergodic systems.
    NoseHooverChain(NoseHooverChain),
    /// One random factor for all velocities, canonical.
    VelocityRescaling(VelocityRescaling),
}

impl Thermostat {
    /// Degrees of freedom of the kinetic energy of `atoms` atoms: 3n, minus 3 where momentum is conserved.
    pub fn degrees_of_freedom(&self, atoms: usize) -> usize {
        match self {
            Self::Langevin(_) => 3 * atoms,
            Self::None | Self::NoseHooverChain(_) | Self::VelocityRescaling(_) => 3 * atoms.saturating_sub(1),
        }
    }

    /// Acts on the velocities (Å/fs) before the first and after the last kick of a step of `time_step` fs. `masses`
    /// in u.
    pub fn half_step(&mut self, velocities: &mut [Vec3], masses: &[f64], time_step: f64) {
        let freedom = self.degrees_of_freedom(masses.len());
        match self {
            Self::NoseHooverChain(chain) => {
                let factor = chain.half_step(state::kinetic_energy(velocities, masses), freedom, time_step);
                velocities.iter_mut().for_each(|v| *v = cell::scale(*v, factor));
            }
            Self::None | Self::Langevin(_) | Self::VelocityRescaling(_) => {}
        }
    }

    /// Acts on the velocities (Å/fs) between the two drifts of a step of `time_step` fs. `masses` in u.
    pub fn exchange(
        &mut self,
        velocities: &mut [Vec3],
        masses: &[f64],
        time_step: f64,
        stream: &Stream,
        step: u64,
    ) {
        match self {
            Self::Langevin(langevin) => langevin.exchange(velocities, masses, time_step, stream, step),
            Self::VelocityRescaling(rescaling) => {
                let (kinetic, atoms) = (state::kinetic_energy(velocities, masses), masses.len());
                let factor = rescaling.factor(kinetic, atoms, time_step, stream, step);
                velocities.iter_mut().for_each(|v| *v = cell::scale(*v, factor));
            }
            Self::None | Self::NoseHooverChain(_) => {}
        }
    }

    /// The thermostat's contribution to the conserved energy, eV; `None` where nothing is conserved.
    pub fn energy(&self, degrees_of_freedom: usize) -> Option<f64> {
        match self {
            Self::None => Some(0.0),
            Self::Langevin(_) => None,
            Self::NoseHooverChain(chain) => Some(chain.energy(degrees_of_freedom)),
            Self::VelocityRescaling(rescaling) => Some(-rescaling.heat),
        }
    }

    /// The first invalid setting for `atoms` atoms.
    pub(crate) fn invalid_setting(&self, atoms: usize) -> Option<&'static str> {
        match self {
            Self::None => None,
            Self::Langevin(langevin) => langevin.invalid_setting(),
            Self::NoseHooverChain(chain) => chain.invalid_setting(atoms),
            Self::VelocityRescaling(rescaling) => rescaling.invalid_setting(atoms),
        }
    }
}
