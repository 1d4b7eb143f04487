//! Langevin dynamics.

use atoms::units::{ACCELERATION, BOLTZMANN};
use atoms::{Vec3, cell};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::random::{Stream, StreamId};
use crate::wrong_setting::{WrongSetting, is_positive};

/// Settings of Langevin dynamics.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LangevinSettings {
    /// Friction, 1/fs.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub friction: f64,
}

impl LangevinSettings {
    pub(crate) fn start(self, temperature: f64) -> Langevin {
        Langevin { temperature, friction: self.friction }
    }

    pub(crate) fn wrong(&self) -> Option<WrongSetting> {
        WrongSetting::unless_positive("langevin.friction", self.friction)
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

    pub(crate) fn invalid_setting(&self) -> Option<&'static str> {
        if !is_positive(self.friction) {
            return Some("the friction must be positive and finite");
        }
        let valid = self.temperature == 0.0 || is_positive(self.temperature);
        (!valid).then_some("the temperature must be finite and not negative")
    }
}
