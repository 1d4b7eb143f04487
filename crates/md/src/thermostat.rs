//! Thermostats.

use atoms::units::{ACCELERATION, BOLTZMANN};
use atoms::{Vec3, cell};
use serde::{Deserialize, Serialize};

use crate::nose_hoover::NoseHooverChain;
use crate::random::{Stream, StreamId};

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
}

impl Thermostat {
    /// Degrees of freedom of the kinetic energy of `atoms` atoms: 3n, minus 3 where momentum is conserved.
    pub fn degrees_of_freedom(&self, atoms: usize) -> usize {
        match self {
            Self::Langevin(_) => 3 * atoms,
            Self::None | Self::NoseHooverChain(_) => 3 * atoms.saturating_sub(1),
        }
    }

    /// Propagates a Nosé–Hoover chain by half of `time_step` (fs). Returns the factor for the velocities.
    pub fn half_step(&mut self, kinetic_energy: f64, degrees_of_freedom: usize, time_step: f64) -> f64 {
        match self {
            Self::NoseHooverChain(chain) => chain.half_step(kinetic_energy, degrees_of_freedom, time_step),
            Self::None | Self::Langevin(_) => 1.0,
        }
    }

    /// The thermostat's contribution to the conserved energy, eV; `None` where nothing is conserved.
    pub fn energy(&self, degrees_of_freedom: usize) -> Option<f64> {
        match self {
            Self::None => Some(0.0),
            Self::Langevin(_) => None,
            Self::NoseHooverChain(chain) => Some(chain.energy(degrees_of_freedom)),
        }
    }

    /// The first invalid setting for `atoms` atoms.
    pub(crate) fn invalid_setting(&self, atoms: usize) -> Option<&'static str> {
        let positive = |x: f64| x.is_finite() && x > 0.0;
        match self {
            Self::None => None,
            Self::Langevin(langevin) if !positive(langevin.friction) => {
                Some("the friction must be positive and finite")
            }
            Self::Langevin(langevin) if !(langevin.temperature == 0.0 || positive(langevin.temperature)) => {
                Some("the temperature must be finite and not negative")
            }
            Self::Langevin(_) => None,
            Self::NoseHooverChain(_) if atoms < 2 => {
                Some("a Nosé–Hoover chain needs at least two atoms: a single one has no thermal motion")
            }
            Self::NoseHooverChain(chain) if !positive(chain.temperature) || !positive(chain.damping_time) => {
                Some("temperature and damping time of the Nosé–Hoover chain must be positive and finite")
            }
            Self::NoseHooverChain(chain)
                if chain.velocities.is_empty() || chain.positions.len() != chain.velocities.len() =>
            {
                Some("a Nosé–Hoover chain needs one or more links, each with a position and a velocity")
            }
            Self::NoseHooverChain(_) => None,
        }
    }
}

/// m dv = F dt − m Γ v dt + √(2 m Γ k_B T) dW.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Langevin {
    /// Temperature, K.
    pub temperature: f64,
    /// Γ, 1/fs.
    pub friction: f64,
}

impl Langevin {
    /// The exact Ornstein–Uhlenbeck step over `time_step` (fs), the O of BAOAB (Leimkuhler & Matthews, Appl.
    /// Math. Res. Express 2013, 34): v ← e^(−Γt) v + √((1 − e^(−2Γt)) k_B T / m) ξ.
    pub fn exchange(
        &self,
        velocities: &mut [Vec3],
        masses: &[f64],
        time_step: f64,
        stream: &Stream,
        step: u64,
    ) {
        let kept = (-self.friction * time_step).exp();
        let heat = -(-2.0 * self.friction * time_step).exp_m1() * BOLTZMANN * self.temperature * ACCELERATION;
        for (atom, (v, mass)) in velocities.iter_mut().zip(masses).enumerate() {
            let noise = stream.normals(step, atom as u32, StreamId::Langevin);
            *v = cell::add(cell::scale(*v, kept), cell::scale(noise, (heat / mass).sqrt()));
        }
    }
}
