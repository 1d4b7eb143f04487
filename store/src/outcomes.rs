//! Results and costs of label jobs.

use atoms::Species;
use serde::Serialize;

/// The cost of a label made in this campaign.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelCost {
    /// Index of the seed structure; [`u32::MAX`] for imported structures.
    pub seed_structure: u32,
    /// Formula.
    pub formula: String,
    /// Number of atoms.
    pub atoms: u32,
    /// Electrons treated, if the method has any.
    pub electrons: Option<f64>,
    /// Number of k-points, if the method has any.
    pub k_points: Option<u32>,
    /// Core-seconds of the successful attempt.
    pub core_seconds: f64,
}

/// Both energies of a labelled structure.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelledEnergies {
    /// Number of atoms of each element.
    pub composition: Vec<(Species, u32)>,
    /// By the potential, eV.
    pub model: f64,
    /// Of the label, eV.
    pub label: f64,
}

/// Label jobs of one size that have no label yet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PendingJobs {
    /// Index of the seed structure; [`u32::MAX`] for imported structures.
    pub seed_structure: u32,
    /// Formula.
    pub formula: String,
    /// Number of atoms.
    pub atoms: u32,
    /// Number of jobs.
    pub jobs: u64,
}

/// Resources that label attempts have used and use now.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LabelUsage {
    /// Core-seconds of all attempts that ended, successful or not; `None` in a database of an earlier version,
    /// which has no such total.
    pub core_seconds: Option<f64>,
    /// Core-seconds of the successful attempts; `None` likewise.
    pub label_core_seconds: Option<f64>,
    /// Cores of the running attempts.
    pub cores: u64,
}

/// How often a failure class occurred.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct FailureCount {
    /// The class.
    pub class: String,
    /// Jobs that met it and were labelled later.
    pub labelled: u64,
    /// Jobs that met it and failed in the end, for this or another reason.
    pub failed: u64,
    /// Jobs that met it and are unfinished.
    pub unfinished: u64,
}

/// Minimum and maximum of some values; `None` without values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ValueRange {
    /// Minimum.
    pub low: Option<f64>,
    /// Maximum.
    pub high: Option<f64>,
}

/// Failed labels of one seed structure and formula: this part of the collected structures has no label.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Unlabelled {
    /// Name of the seed structure; `imported` for imported structures.
    pub seed_structure: String,
    /// Formula.
    pub formula: String,
    /// Structures whose labels failed.
    pub failed: u64,
    /// Structures that have their label.
    pub labelled: u64,
    /// Range of the largest γ of the failed ones that walks with one version of the potential found, under its original
    /// mixture.
    pub gamma: ValueRange,
    /// The same for the labelled ones.
    pub gamma_labelled: ValueRange,
    /// Range of V/V₀ of the failed ones.
    pub relative_volume: ValueRange,
    /// The same for the labelled ones.
    pub relative_volume_labelled: ValueRange,
}

/// A labelled structure that may nearly duplicate another.
#[derive(Clone, Debug, PartialEq)]
pub struct NearDuplicate {
    /// Name of the candidate.
    pub candidate: String,
    /// Its features, [n × D].
    pub features: Vec<f64>,
}
