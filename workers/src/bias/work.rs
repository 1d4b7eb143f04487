//! Work done by the bias along the path of a walk.

use serde::{Deserialize, Serialize};

/// The integral of the bias's power, part of a walk's checkpoint.
///
/// The trapezoid over whole steps, at whose ends velocity and force belong to the same time. Velocity Verlet and BAOAB kick with
/// the force of a step before and after it; the two half kicks together do the work F·v Δt exactly, so the sum misses what
/// the integrator does only by half a kick at each end, of second order in Δt.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BiasWork {
    /// Since the start of the walk, eV.
    pub total: f64,
    /// Power after the last step, eV/fs.
    power: f64,
}

impl BiasWork {
    /// Adds a step of `time_step` fs, after which the power is `power`, eV/fs.
    pub fn advance(&mut self, power: f64, time_step: f64) {
        self.total += 0.5 * time_step * (self.power + power);
        self.power = power;
    }

    /// Takes note that the velocities were multiplied by `factor`, which changed the kinetic energy by `energy`, eV.
    pub fn velocities_scaled(&mut self, factor: f64, energy: f64) {
        self.total += energy;
        self.power *= factor;
    }
}
