//! What the store knows of one candidate or imported structure.

use atoms::Structure;
use serde::Serialize;
use wire::ContentHash;

use crate::jobs::LabelRecord;
use crate::records::{CandidateRef, Protocol};

/// A structure imported with its label.
#[derive(Clone, Debug, PartialEq)]
pub struct ImportedStructure {
    /// Its import number, from 1.
    pub number: i64,
    /// Its source file.
    pub file: String,
    /// The frame in it, from 0.
    pub frame: u64,
    /// The structure.
    pub structure: Structure,
    /// Its hash.
    pub content: ContentHash,
}

/// Other occurrences of the same structure.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SameStructure {
    /// Accepted candidates and frames of control walks, in decision order.
    pub candidates: Vec<CandidateRef>,
    /// Number of the import.
    pub import: Option<i64>,
}

/// A label of a structure, whatever its protocol.
#[derive(Clone, Debug, PartialEq)]
pub struct StructureLabel {
    /// The protocol.
    pub protocol: Protocol,
    /// The label.
    pub record: LabelRecord,
}

/// A candidate declined as covered under a newer mixture than its walker had seen.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct CoveredCandidate {
    /// The candidate.
    #[serde(flatten)]
    pub named: CandidateRef,
    /// Version of the mixture that its walker saw.
    pub seen: u64,
    /// Version under which it was declined.
    pub decided: u64,
}

/// Candidates covered later, as far as the search went.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LaterCoveredCandidates {
    /// In decision order.
    pub candidates: Vec<CoveredCandidate>,
    /// The last decision that was examined, if there may be more after it.
    pub searched_until: Option<i64>,
}
