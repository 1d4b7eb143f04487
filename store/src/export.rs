//! What an export reads: labelled structures in an order that does not depend on when labels came.

use atoms::Structure;
use wire::{CandidateBlock, ContentHash, Origin};

use crate::records::{AtomGrades, Label};

/// Which labelled structures.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExportFilter {
    /// The protocol of the labels.
    pub protocol: ContentHash,
    /// Candidates of biased walks.
    pub biased: bool,
    /// Frames of control walks.
    pub control: bool,
    /// Structures that came with their labels.
    pub imported: bool,
}

/// Place of a row in the order of exports: candidates in decision order, then imports as they came.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum ExportCursor {
    /// Number of the decision.
    Candidate(i64),
    /// Number of the import.
    Import(i64),
}

/// A labelled structure.
#[derive(Clone, Debug)]
pub struct ExportRow {
    /// Where it stands; the next page begins after it.
    pub cursor: ExportCursor,
    /// Where it came from.
    pub source: ExportSource,
    /// The structure.
    pub structure: Structure,
    /// Its label.
    pub label: Label,
    /// Name of the protocol.
    pub protocol_name: String,
    /// Hash of the protocol.
    pub protocol: ContentHash,
}

/// Where an exported structure came from.
#[derive(Clone, Debug)]
pub enum ExportSource {
    /// A walk.
    Candidate {
        /// Name of the candidate.
        id: String,
        /// Index of the seed structure.
        seed_structure: u32,
        /// Its name.
        seed_structure_name: String,
        /// Biased or control.
        origin: Origin,
        /// Version of the mixture after the decision.
        mixture_version_after: u64,
        /// Everything that the walker knew (walk, segment, step, the version that it saw, the potential's forces),
        /// without features.
        block: CandidateBlock,
        /// γ and γ_nbr under the original mixture.
        original: AtomGrades,
    },
    /// A file.
    Import {
        /// Its name.
        file: String,
        /// The frame in it, from 0.
        frame: u64,
    },
}
