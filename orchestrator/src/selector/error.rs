//! Errors.

use atoms::CloseContact;
use calm::MixtureError;
use wire::CandidateId;

use crate::grader::GraderError;

/// Why the selector failed.
#[derive(Debug, thiserror::Error)]
pub enum SelectorError {
    /// A candidate that cannot be graded.
    #[error("candidate {candidate}: {source}")]
    Grade {
        /// The candidate.
        candidate: CandidateId,
        /// The error.
        source: GraderError,
    },
    /// A control frame that no label is calculated for.
    #[error(
        "control frame {candidate}: {} atoms at {:.3} Å, closer than the limit of {:.3} Å",
        .contact.pair, .contact.distance, .contact.limit
    )]
    TooClose {
        /// The frame.
        candidate: CandidateId,
        /// Its atoms that are too close.
        contact: CloseContact,
    },
    /// The mixture update failed.
    #[error("updating the mixture for candidate {candidate}: {source}")]
    Update {
        /// The candidate.
        candidate: CandidateId,
        /// The error.
        source: calm::UpdateError,
    },
    /// Components that do not form a mixture.
    #[error(transparent)]
    Mixture(#[from] MixtureError),
    /// An unusable seed structure.
    #[error("seed structure '{name}': {source}")]
    SeedStructure {
        /// Name of the seed structure.
        name: String,
        /// The error.
        source: GraderError,
    },
    /// A database that does not match the campaign.
    #[error("cannot continue the campaign's database: {0}")]
    Snapshot(String),
    /// A mixture under which training atoms have no grade: of a database, or after the update for a candidate.
    #[error("grading the training frames under the live mixture: {source}")]
    Training {
        /// The error.
        source: calm::GradeError,
    },
}

impl SelectorError {
    /// Whether an error in a decision is the fault of its candidate, so that the campaign can continue without it.
    pub(super) fn is_of_candidate(&self) -> bool {
        matches!(
            self,
            Self::Grade { .. } | Self::TooClose { .. } | Self::Update { .. } | Self::Training { .. }
        )
    }
}
