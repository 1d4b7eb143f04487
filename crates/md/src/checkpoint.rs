//! Everything that determines how a run goes on.

use atoms::Evaluation;
use serde::{Deserialize, Serialize};

use crate::dynamics::DynamicsError;
use crate::random::Stream;
use crate::state::State;
use crate::thermostat::Thermostat;
use crate::volume_ramp::VolumeRamp;

/// A run between two steps.
///
/// The last evaluation is part of it, so that going on evaluates nothing twice: a potential with memory
/// sees each structure once. Encodings must keep every bit of a number (a JSON reader may not).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Checkpoint {
    /// Structure, velocities, step.
    pub state: State,
    /// Energies, forces and virial at the structure.
    pub evaluation: Evaluation,
    /// The thermostat with its dynamical variables.
    pub thermostat: Thermostat,
    /// The volume ramp, if there is one.
    pub ramp: Option<VolumeRamp>,
    /// fs.
    pub time_step: f64,
    /// Whose random numbers are used. A walk that goes back here gives it a new segment.
    pub stream: Stream,
}

impl Checkpoint {
    /// Checks lengths and numbers, as a checkpoint may come from a file.
    ///
    /// # Errors
    /// The first fault found.
    pub fn validate(&self) -> Result<(), DynamicsError> {
        self.state.structure.validate()?;
        let n = self.state.structure.len();
        for (array, found) in [
            ("velocities", self.state.velocities.len()),
            ("forces", self.evaluation.forces.len()),
            ("atomic energies", self.evaluation.atomic_energies.len()),
        ] {
            if found != n {
                return Err(DynamicsError::Length { array, found, expected: n });
            }
        }
        if !(self.time_step.is_finite() && self.time_step > 0.0) {
            return Err(DynamicsError::TimeStep(self.time_step));
        }
        if let Some(fault) = self.thermostat.invalid_setting(n) {
            return Err(DynamicsError::Thermostat(fault));
        }
        match self.ramp {
            Some(ramp) if !ramp.is_valid() => Err(DynamicsError::Ramp { from: ramp.from, to: ramp.to }),
            _ => Ok(()),
        }
    }
}
