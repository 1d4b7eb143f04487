//! Grading of candidates by the selector. It can run before the decision, on any thread and in any order.

use std::sync::Arc;

use calm::Mixture;
use store::records::AtomGrades;
use wire::CandidateBlock;
use wire::messages::AssignmentReport;

use super::error::SelectorError;
use crate::grader::{Grader, StructureBonds};

/// Grades candidates ahead of the decisions about them. Cheap to clone.
#[derive(Clone)]
pub struct Regrader {
    pub(super) grader: Arc<Grader>,
    pub(super) original: Arc<Mixture>,
}

/// A candidate with its grades.
pub struct RegradedCandidate {
    pub(super) block: CandidateBlock,
    pub(super) bonds: StructureBonds,
    /// Grades under the original mixture.
    pub(super) original: AtomGrades,
    /// The mixture of the selector's grades.
    pub(super) mixture: Arc<Mixture>,
    pub(super) selector: AtomGrades,
}

/// A report with a regraded candidate, or the error, which is returned only if the candidate comes to a decision.
pub type RegradedReport = AssignmentReport<Result<RegradedCandidate, SelectorError>>;

impl Regrader {
    /// Grades the candidate of a report, if it has one. `mixture` should be the mixture at the time of the decision;
    /// under another one, the candidate is graded again.
    pub fn regrade(&self, report: AssignmentReport, mixture: &Arc<Mixture>) -> RegradedReport {
        report.map_candidate(|block| self.regrade_block(block, mixture))
    }

    /// Grades a candidate without a report.
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
    /// The candidate with grades under the current mixture.
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
