//! What a report reads of all that was collected, labelled or not.

use atoms::Vec3;
use wire::{CandidateBlock, Origin};

use crate::records::{AtomGrades, JobState};

/// A structure that was accepted, or a frame of a control walk.
#[derive(Clone, Debug)]
pub struct CollectedStructure {
    /// Number of the decision about it; the next page begins after it.
    pub decision: i64,
    /// Biased or control.
    pub origin: Origin,
    /// Index of the seed structure.
    pub seed_structure: u32,
    /// Everything that the walker knew, without features.
    pub block: CandidateBlock,
    /// γ and γ_nbr under the original mixture.
    pub original: AtomGrades,
    /// State of its label job; `None` if there is none.
    pub job: Option<JobState>,
    /// Forces of its label, [n], eV/Å; `None` if it has none, or was dropped by hand.
    pub label_forces: Option<Vec<Vec3>>,
}

/// How many candidates of biased walks came to one end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FateCount {
    /// The part of the decision log, or the seed structure, from 0.
    pub part: u64,
    /// `accepted`, or why they were declined.
    pub fate: String,
    /// How many.
    pub number: u64,
}
