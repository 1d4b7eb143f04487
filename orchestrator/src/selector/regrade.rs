//! What can be found out about a candidate before its turn to be decided comes: on any thread, in any order.

use std::sync::Arc;

use calm::Mixture;
use store::records::AtomGrades;
use wire::CandidateBlock;
use wire::messages::Report;

use super::SelectorError;
use crate::grader::{Bonds, Grader};

/// Grades candidates ahead of the decisions about them. Clones share what they need.
#[derive(Clone)]
pub struct Regrader {
    pub(super) grader: Arc<Grader>,
    pub(super) original: Arc<Mixture>,
}

/// A candidate with its grades.
pub struct RegradedCandidate {
    pub(super) block: CandidateBlock,
    pub(super) bonds: Bonds,
    /// Under the original mixture.
    pub(super) original: AtomGrades,
    /// The mixture of the grades below.
    pub(super) mixture: Arc<Mixture>,
    pub(super) selector: AtomGrades,
}

/// A report with its candidate regraded, or why it cannot be: an error if it comes to a decision about it.
pub type RegradedReport = Report<Result<RegradedCandidate, SelectorError>>;

impl Regrader {
    /// Examines the candidate of a report, if it has one. `mixture` is the one that is likely to be in force when it is
    /// decided; under any other it will be graded again.
    pub fn regrade(&self, report: Report, mixture: &Arc<Mixture>) -> RegradedReport {
        report.map_candidate(|block| self.regrade_block(block, mixture))
    }

    /// The same of a candidate alone.
    pub fn regrade_block(
        &self,
        block: CandidateBlock,
        mixture: &Arc<Mixture>,
    ) -> Result<RegradedCandidate, SelectorError> {
        let view = block.view();
        let failed = |source| SelectorError::Grade { candidate: view.id(), source };
        let bonds = self.grader.bonds(&view.structure()).map_err(failed)?;
        let selector = bonds.grade(mixture, view.features).map_err(failed)?;
        let original = if Arc::ptr_eq(mixture, &self.original) {
            selector.clone()
        } else {
            bonds.grade(&self.original, view.features).map_err(failed)?
        };
        Ok(RegradedCandidate { block, bonds, original, mixture: Arc::clone(mixture), selector })
    }
}

impl RegradedCandidate {
    /// The same under the mixture in force.
    pub(super) fn with_mixture(mut self, mixture: &Arc<Mixture>) -> Result<Self, SelectorError> {
        if !Arc::ptr_eq(mixture, &self.mixture) {
            let view = self.block.view();
            let failed = |source| SelectorError::Grade { candidate: view.id(), source };
            self.selector = self.bonds.grade(mixture, view.features).map_err(failed)?;
            self.mixture = Arc::clone(mixture);
        }
        Ok(self)
    }
}
