//! The complete state of a run.

use atoms::Evaluation;
use serde::{Deserialize, Serialize};

use crate::cell_motion::CellMotion;
use crate::error::DynamicsError;
use crate::random::Stream;
use crate::state::State;
use crate::thermostat::Thermostat;

/// A run between two steps.
///
/// Includes the last evaluation, so that resuming evaluates nothing twice and a potential with memory sees each
/// structure once. Encodings must preserve every bit of a number, which JSON readers may not.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Checkpoint {
    /// Structure, velocities, step.
    pub state: State,
    /// Energies, forces and virial at the structure.
    pub evaluation: Evaluation,
    /// The thermostat with its dynamical variables.
    pub thermostat: Thermostat,
    /// How the cell moves, with its dynamical variables.
    pub cell_motion: CellMotion,
    /// fs.
    pub time_step: f64,
    /// The random stream. A walk that rolls back to this checkpoint gets a new segment.
    pub stream: Stream,
}

impl Checkpoint {
    /// Checks lengths and values, because a checkpoint may come from a file.
    ///
    /// # Errors
    /// The first fault.
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
        match &self.cell_motion {
            CellMotion::VolumeRamp(ramp) if !ramp.is_valid() => {
                Err(DynamicsError::Ramp { from: ramp.from, to: ramp.to })
            }
            CellMotion::Barostat(barostat) => {
                let fault = barostat.invalid_setting(&self.thermostat, &self.state.structure);
                fault.map_or(Ok(()), |fault| Err(DynamicsError::Barostat(fault)))
            }
            CellMotion::Fixed | CellMotion::VolumeRamp(_) => Ok(()),
        }
    }
}
