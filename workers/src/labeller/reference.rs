//! Labels from a potential instead of DFT, as in the paper's own tests.

use atoms::{Evaluation, NeighbourList, Potential, Structure};
use dft::{CalculationResults, Failure, FailureClass};

/// A reference potential.
pub struct ReferenceMethod {
    potential: Box<dyn Potential>,
    evaluation: Evaluation,
}

impl ReferenceMethod {
    /// Labels by this potential.
    pub fn new(potential: Box<dyn Potential>) -> Self {
        Self { potential, evaluation: Evaluation::default() }
    }

    /// Energy, forces and, where defined, stress.
    ///
    /// # Errors
    /// [`FailureClass::BadInput`] for a structure that the potential cannot evaluate.
    pub fn label(&mut self, structure: &Structure) -> Result<CalculationResults, Failure> {
        let mut neighbours = NeighbourList::new(self.potential.cutoff(), 0.0);
        neighbours
            .update(structure)
            .map_err(|error| FailureClass::BadInput.with_message(error.to_string()))?;
        let evaluated = self.potential.evaluate(structure, &neighbours, &mut self.evaluation);
        evaluated.map_err(|error| FailureClass::BadInput.with_message(error.to_string()))?;
        let evaluation = &self.evaluation;
        Ok(CalculationResults {
            energy: evaluation.energy(),
            forces: evaluation.forces.clone(),
            stress: evaluation.stress(structure),
            ..CalculationResults::default()
        })
    }
}
