//! What became of label jobs, and what they took.

use atoms::Species;
use serde::Serialize;
use wire::Origin;

use crate::records::AtomGrades;

/// What a label took that was made in this campaign.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelCost {
    /// Index of the seed structure.
    pub seed_structure: u32,
    /// Formula.
    pub formula: String,
    /// Number of atoms.
    pub atoms: u32,
    /// Electrons that were treated, if the method has any.
    pub electrons: Option<f64>,
    /// Points of the k-point mesh, if the method has one.
    pub k_points: Option<u32>,
    /// Core-seconds of the attempt that brought it.
    pub core_seconds: f64,
}

/// Both energies of a labelled structure.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelledEnergies {
    /// Numbers of atoms of its elements.
    pub composition: Vec<(Species, u32)>,
    /// By the potential, eV.
    pub model: f64,
    /// Of the label, eV.
    pub label: f64,
}

/// Jobs of one size that have no label yet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PendingJobs {
    /// Index of the seed structure.
    pub seed_structure: u32,
    /// Formula.
    pub formula: String,
    /// Number of atoms.
    pub atoms: u32,
    /// How many.
    pub jobs: u64,
}

/// What label attempts have used so far, and what is at work.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LabelUsage {
    /// Core-seconds of all attempts that ended, also of those that brought nothing; `None` in a database of an earlier
    /// version, which keeps no such sum.
    pub core_seconds: Option<f64>,
    /// Those of them that brought labels; `None` likewise.
    pub label_core_seconds: Option<f64>,
    /// Cores of the attempts under way.
    pub cores: u64,
}

/// How often a class of failure was met.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct FailureCount {
    /// The class, as attempts have it.
    pub class: String,
    /// Jobs that met it and have their labels all the same.
    pub labelled: u64,
    /// Jobs that met it and were given up, by this or another.
    pub given_up: u64,
    /// Jobs that met it and are not done.
    pub unfinished: u64,
}

/// Least and largest of some values; none of none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ValueRange {
    /// Least.
    pub low: Option<f64>,
    /// Largest.
    pub high: Option<f64>,
}

/// Where labels of one seed structure and formula finally failed: this part of what was collected has no label.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Unlabelled {
    /// Name of the seed structure.
    pub seed_structure: String,
    /// Formula.
    pub formula: String,
    /// Structures whose labels failed.
    pub failed: u64,
    /// Those that have their labels.
    pub labelled: u64,
    /// Largest γ of the former, under the original mixture.
    pub gamma: ValueRange,
    /// The same of the latter.
    pub gamma_labelled: ValueRange,
    /// V/V₀ of the former.
    pub relative_volume: ValueRange,
    /// The same of the latter.
    pub relative_volume_labelled: ValueRange,
}

/// A candidate whose job has come to its end. Several have one job if they are the same structure, such as the first steps
/// of a walk and of its control.
#[derive(Clone, Debug, PartialEq)]
pub struct FinishedCandidate {
    /// Number of the decision about it; the next page begins after it.
    pub decision: i64,
    /// Name of the candidate.
    pub candidate: String,
    /// Whether it has its label; if not, all attempts failed.
    pub labelled: bool,
    /// Biased or control.
    pub origin: Origin,
    /// Name of the seed structure.
    pub seed_structure: String,
    /// Formula.
    pub formula: String,
    /// Largest γ under the original mixture.
    pub gamma: Option<f64>,
    /// Largest γ_nbr under the original mixture.
    pub gamma_nbr: Option<f64>,
    /// V/V₀.
    pub relative_volume: Option<f64>,
    /// Class of the last attempt, if its label failed.
    pub class: Option<String>,
    /// γ and γ_nbr of its atoms under the original mixture, if its label failed.
    pub unlabelled: Option<AtomGrades>,
}

/// A labelled structure that may be almost the same as another.
#[derive(Clone, Debug, PartialEq)]
pub struct NearDuplicate {
    /// Name of the candidate.
    pub candidate: String,
    /// Its features, [n × D].
    pub features: Vec<f64>,
}
