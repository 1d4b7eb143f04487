//! The value of queued labels, and what it is computed from.

use atoms::Structure;
use serde_json::Value;

use crate::records::AtomGrades;

/// A structure found by a walk whose label job is finished.
#[derive(Clone, Debug, PartialEq)]
pub struct FinishedStructure {
    /// Sequence number of the decision on it.
    pub decision: i64,
    /// Number of its walk.
    pub walk: u32,
    /// Index of the seed structure.
    pub seed_structure: u32,
    /// Whether it has a label; otherwise all attempts failed.
    pub labelled: bool,
    /// Largest γ under the original mixture.
    pub gamma: Option<f64>,
    /// V/V₀.
    pub relative_volume: Option<f64>,
    /// The structure.
    pub structure: Structure,
}

/// A structure found by a walk that waits for its label, or whose label is in work.
#[derive(Clone, Debug, PartialEq)]
pub struct QueuedStructure {
    /// Id of the job.
    pub job: i64,
    /// Sequence number of the decision on it.
    pub decision: i64,
    /// Number of its walk.
    pub walk: u32,
    /// Index of the seed structure.
    pub seed_structure: u32,
    /// Formula.
    pub formula: String,
    /// Priority of its job; higher first.
    pub priority: i32,
    /// Whether a labeller holds its job.
    pub leased: bool,
    /// V/V₀.
    pub relative_volume: Option<f64>,
    /// γ and γ_nbr of its atoms under the original mixture.
    pub original: AtomGrades,
    /// Number of structures of the same priority that were found after it and are finished.
    pub overtaken: u64,
    /// The structure.
    pub structure: Structure,
}

/// The value of the label of a queued structure.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelValue {
    /// Id of the job.
    pub job: i64,
    /// Value, 0 or more: among jobs of equal priority, the largest is leased first.
    pub value: f64,
    /// Its factors, a JSON object.
    pub factors: Value,
}
