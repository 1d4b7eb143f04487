//! A step of a walk, for observers.

use atoms::{Evaluation, PotentialError, Structure, Vec3};
use wire::messages::PathPosition;

use super::{RunningWalk, gamma};

/// The state of a walk at its start, or after a step.
pub struct StepView<'a, 'w> {
    pub(super) walk: &'a mut RunningWalk<'w>,
}

impl StepView<'_, '_> {
    /// Segment and step.
    pub fn position(&self) -> PathPosition {
        self.walk.progress().position()
    }

    /// Step times time step, fs.
    pub fn time(&self) -> f64 {
        self.walk.step() as f64 * self.walk.dynamics.checkpoint().time_step
    }

    /// Kinetic temperature, K.
    pub fn temperature(&self) -> f64 {
        self.walk.dynamics.temperature()
    }

    /// The structure.
    pub fn structure(&self) -> &Structure {
        self.walk.dynamics.structure()
    }

    /// Å/fs.
    pub fn velocities(&self) -> &[Vec3] {
        &self.walk.dynamics.state().velocities
    }

    /// u.
    pub fn masses(&self) -> &[f64] {
        self.walk.dynamics.masses()
    }

    /// Takes the forces of the potential and of the bias apart, for [`StepView::physical`].
    ///
    /// # Errors
    /// A potential that cannot be evaluated any more.
    pub fn separate(&mut self) -> Result<(), PotentialError> {
        let RunningWalk { potential, dynamics, .. } = &mut *self.walk;
        potential.separate(dynamics.structure(), dynamics.neighbours())
    }

    /// Energy, forces and virial of the potential, without bias and ZBL, as candidates have them.
    pub fn physical(&self) -> &Evaluation {
        self.walk.potential.physical()
    }

    /// γ of each atom under the walker's mixture; `None` if the structure cannot be graded. Costs a forward pass where the bias is off.
    pub fn gamma(&mut self) -> Option<Vec<f64>> {
        let walk = &mut *self.walk;
        gamma(&mut walk.potential, &walk.dynamics).ok().map(<[f64]>::to_vec)
    }
}
