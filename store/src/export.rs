//! Rows of an export: labelled structures in an order that does not depend on when their labels arrived.

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
    /// Structures imported with their labels.
    pub imported: bool,
}

/// Position of a row in an export: candidates in decision order, then imports in import order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ExportCursor {
    /// Sequence number of the decision.
    Candidate(i64),
    /// Import number.
    Import(i64),
}

/// What tells one set of labels from another, without the structures and labels themselves.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelMark {
    /// Its position.
    pub cursor: ExportCursor,
    /// Name of the seed structure and origin; `None` for an import.
    pub walk: Option<(String, Origin)>,
    /// Energy of the label, eV.
    pub energy: f64,
}

/// A labelled structure.
#[derive(Clone, Debug)]
pub struct ExportRow {
    /// Its position; the next page starts after it.
    pub cursor: ExportCursor,
    /// Its origin.
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

/// Origin of an exported structure.
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
        /// All data of the walker (walk, segment, step, mixture version, the potential's forces), without features.
        block: CandidateBlock,
        /// Largest γ under the selector's mixture at the decision, before the update.
        selector_gamma: Option<f64>,
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
