//! Labelled candidates, and candidates whose label failed: what errors of the potential follow from.

use atoms::Structure;
use wire::{CandidateBlock, ContentHash, Origin};

use crate::records::{AtomGrades, JobState, Label};

/// A labelled candidate.
#[derive(Clone, Debug)]
pub struct LabelledCandidate {
    /// Sequence number of its decision.
    pub decision: i64,
    /// Index of the seed structure.
    pub seed_structure: u32,
    /// Largest γ under the original mixture.
    pub gamma: Option<f64>,
    /// V/V₀.
    pub relative_volume: Option<f64>,
    /// The structure.
    pub structure: Structure,
    /// All data of the walker, without features.
    pub block: CandidateBlock,
    /// γ and γ_nbr under the original mixture.
    pub original: AtomGrades,
    /// The label.
    pub label: Label,
    /// State of the label job of the structure under the protocol.
    pub job: Option<JobState>,
}

/// A candidate whose label failed in all attempts.
#[derive(Clone, Debug, PartialEq)]
pub struct FailedCandidate {
    /// Sequence number of its decision; the next page starts after it.
    pub decision: i64,
    /// Name of the candidate.
    pub candidate: String,
    /// Number of its walk.
    pub walk: u32,
    /// Step of its walk.
    pub step: u64,
    /// Hash of its structure.
    pub content: ContentHash,
    /// Biased or control.
    pub origin: Origin,
    /// Largest γ under the original mixture.
    pub gamma: Option<f64>,
    /// V/V₀.
    pub relative_volume: Option<f64>,
    /// γ and γ_nbr of its atoms under the original mixture.
    pub original: AtomGrades,
}

/// A label with a candidate of its structure. A structure that several walks found comes once with each of its candidates.
#[derive(Clone, Debug)]
pub struct LabelArrival {
    /// Number of the label; labels have ascending numbers as they are stored.
    pub number: i64,
    /// The labelled candidate.
    pub candidate: LabelledCandidate,
}

/// A sum over rows of labels, by which a reader notices that what it has read has changed since.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ArrivalSum {
    /// Number of rows.
    pub(crate) rows: u64,
    /// Sum of x³ mod p over the rows, where x = 48271 label + 69621 decision mod p.
    pub(crate) sum: i64,
}

impl ArrivalSum {
    /// p = 2³¹ − 1.
    const MODULUS: i64 = 2_147_483_647;

    /// Adds a row.
    pub fn add(&mut self, arrival: &LabelArrival) {
        let x = (48_271 * arrival.number + 69_621 * arrival.candidate.decision) % Self::MODULUS;
        self.rows += 1;
        self.sum += x * x % Self::MODULUS * x % Self::MODULUS;
    }
}
