//! Labels from a potential in place of DFT, as in the paper's own tests.

use atoms::{Evaluation, NeighbourList, Potential, PotentialError, Structure, StructureError};
use store::records::Label;

/// A reference potential.
pub struct ReferenceMethod {
    potential: Box<dyn Potential>,
    evaluation: Evaluation,
}

/// Why there is no label.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LabelFailure {
    /// The structure cannot be evaluated.
    #[error(transparent)]
    Structure(#[from] StructureError),
    /// The potential cannot evaluate it.
    #[error(transparent)]
    Potential(#[from] PotentialError),
    /// The result cannot be believed.
    #[error("implausible result: {0}")]
    Implausible(String),
}

impl LabelFailure {
    /// Short name of the kind of failure, as the store keeps it.
    pub fn class(&self) -> &'static str {
        match self {
            Self::Structure(_) | Self::Potential(_) => "bad_input",
            Self::Implausible(_) => "implausible",
        }
    }
}

impl ReferenceMethod {
    /// Labels by this potential.
    pub fn new(potential: Box<dyn Potential>) -> Self {
        Self { potential, evaluation: Evaluation::default() }
    }

    /// Energy, forces and, where it is defined, stress.
    pub fn label(&mut self, structure: &Structure) -> Result<Label, LabelFailure> {
        let mut neighbours = NeighbourList::new(self.potential.cutoff(), 0.0);
        neighbours.update(structure)?;
        self.potential.evaluate(structure, &neighbours, &mut self.evaluation)?;
        let evaluation = &self.evaluation;
        Ok(Label {
            energy: evaluation.energy(),
            forces: evaluation.forces.clone(),
            stress: evaluation.stress(structure),
        })
    }
}
