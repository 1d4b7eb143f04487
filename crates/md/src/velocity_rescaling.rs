//! Stochastic velocity rescaling.

use atoms::units::BOLTZMANN;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::random::{Stream, StreamId};
use crate::wrong_setting::{WrongSetting, is_positive};

/// Settings of stochastic velocity rescaling.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct VelocityRescalingSettings {
    /// Relaxation time, fs.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub relaxation_time: f64,
}

impl VelocityRescalingSettings {
    pub(crate) fn start(self, temperature: f64) -> VelocityRescaling {
        VelocityRescaling { temperature, relaxation_time: self.relaxation_time, heat: 0.0 }
    }

    pub(crate) fn wrong(&self) -> Option<WrongSetting> {
        WrongSetting::unless_positive("velocity_rescaling.relaxation_time", self.relaxation_time)
    }
}

/// Canonical sampling by one random factor for all velocities (Bussi, Donadio & Parrinello, J. Chem. Phys. 126, 014101
/// (2007)). Conserves momentum, and disturbs the motion of single atoms least of all thermostats.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct VelocityRescaling {
    /// Temperature, K.
    pub temperature: f64,
    /// Relaxation time of the kinetic energy, fs.
    pub relaxation_time: f64,
    /// Energy given to the atoms so far, eV.
    pub heat: f64,
}

impl VelocityRescaling {
    /// The factor for the velocities after `time_step` (fs) at `kinetic_energy` K (eV) of `atoms` atoms with g = 3
    /// (`atoms` − 1) degrees of freedom: the exact solution of the paper's appendix,
    ///
    /// α² = c + (1 − c) K̄ Σ R_k² / (g K) + 2 R₁ √(c (1 − c) K̄ / (g K)), c = e^(−t/τ), K̄ = g k_B T / 2,
    ///
    /// with the sign of R₁ + √(c g K / ((1 − c) K̄)). Atoms at rest stay at rest.
    pub fn factor(
        &mut self,
        kinetic_energy: f64,
        atoms: usize,
        time_step: f64,
        stream: &Stream,
        step: u64,
    ) -> f64 {
        if kinetic_energy <= 0.0 {
            return 1.0;
        }
        let kept = (-time_step / self.relaxation_time).exp();
        let renewed = -(-time_step / self.relaxation_time).exp_m1();
        let noise = |k: usize| stream.normals(step, k as u32, StreamId::VelocityRescaling);
        let first = noise(0)[0];
        let squares: f64 =
            (0..atoms.saturating_sub(1)).map(|k| noise(k).iter().map(|x| x * x).sum::<f64>()).sum();
        // K̄ / g
        let share = 0.5 * BOLTZMANN * self.temperature;
        let square = kept
            + renewed * share * squares / kinetic_energy
            + 2.0 * first * (kept * renewed * share / kinetic_energy).sqrt();
        let sign = (first + (kept * kinetic_energy / (renewed * share)).sqrt()).signum();
        self.heat += (square - 1.0) * kinetic_energy;
        sign * square.max(0.0).sqrt()
    }

    pub(crate) fn invalid_setting(&self, atoms: usize) -> Option<&'static str> {
        if atoms < 2 {
            return Some("velocity rescaling needs at least two atoms: a single one has no thermal motion");
        }
        let valid =
            is_positive(self.temperature) && is_positive(self.relaxation_time) && self.heat.is_finite();
        (!valid)
            .then_some("temperature and relaxation time of velocity rescaling must be positive and finite")
    }
}
