//! Rows that a report reads: all collected structures, labelled or not.

use atoms::Vec3;
use wire::{CandidateBlock, Origin};

use crate::records::{AtomGrades, JobState};

/// An accepted structure, or a frame of a control walk.
#[derive(Clone, Debug)]
pub struct CollectedStructure {
    /// Sequence number of the decision on it; the next page starts after it.
    pub decision: i64,
    /// Biased or control.
    pub origin: Origin,
    /// Index of the seed structure.
    pub seed_structure: u32,
    /// All data of the walker, without features.
    pub block: CandidateBlock,
    /// γ and γ_nbr under the original mixture.
    pub original: AtomGrades,
    /// State of its label job; `None` without a job.
    pub job: Option<JobState>,
    /// Forces of its label, [n], eV/Å; `None` without a label, or if it was dropped by hand.
    pub label_forces: Option<Vec<Vec3>>,
}

/// Decisions on collected structures, or an even sample of them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DecisionSample {
    /// Number of collected structures that the sample stands for.
    pub total: u64,
    /// Their sequence numbers, in order.
    pub decisions: Vec<i64>,
}

/// An accepted structure, or a frame of a control walk, with its features.
#[derive(Clone, Debug)]
pub struct CollectedFeatures {
    /// Sequence number of the decision on it.
    pub decision: i64,
    /// All data of the walker, without features.
    pub block: CandidateBlock,
    /// Features of all atoms, one after the other; `None` if they are not kept.
    pub features: Option<Vec<f64>>,
    /// γ and γ_nbr under the selector's mixture.
    pub selector: AtomGrades,
    /// The same under the original mixture.
    pub original: AtomGrades,
    /// Forces of its label, [n], eV/Å; `None` without a label, or if it was dropped by hand.
    pub label_forces: Option<Vec<Vec3>>,
}

/// Number of candidates of biased walks with one fate.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FateCount {
    /// Interval of the decision log, index of the seed structure or number of the walk, from 0.
    pub part: u64,
    /// `accepted`, or the reason of the decline.
    pub fate: String,
    /// Number of candidates.
    pub number: u64,
}
