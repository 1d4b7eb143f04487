//! Pages of the candidate table, in orders that have an index.

use serde::Serialize;

/// The order of candidates; ties are ordered by decision.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ListOrder {
    /// As they were decided.
    Decision,
    /// Largest γ under the original mixture. Leaves out candidates without a finite value.
    Gamma,
    /// V/V₀. Leaves out candidates without a finite value.
    Volume,
}

/// Stands for the value of a job without one in a [`ListCursor`]: values are not negative.
pub const NO_LABEL_VALUE: f64 = -1.0;

/// The end of a page: its sort value and decision.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ListCursor {
    /// Priority of the job; ignored for any order but that of the queue.
    pub priority: i32,
    /// γ or V/V₀, or the value of the job in the order of the queue ([`NO_LABEL_VALUE`] without one); ignored for any other order.
    pub value: f64,
    /// Number of the decision.
    pub decision: i64,
}

/// Least and largest values of the candidates of a page; `None` without a limit. A candidate without the value is outside of
/// any limit.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ListLimits {
    /// Largest γ under the original mixture.
    pub gamma: [Option<f64>; 2],
    /// V/V₀.
    pub relative_volume: [Option<f64>; 2],
}

/// A row of the table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ListedCandidate {
    /// Sequence number of the decision on it.
    pub decision: i64,
    /// Its name.
    pub id: String,
    /// `biased` or `control`.
    pub origin: String,
    /// `accepted`, or the reason of the decline.
    pub fate: String,
    /// Number of its walk.
    pub walk: u32,
    /// Segment of the walk (between two roll backs to a checkpoint).
    pub segment: u32,
    /// Step, equilibration included.
    pub step: u64,
    /// Name of the seed structure.
    pub seed_structure: String,
    /// Version of the mixture after the decision.
    pub mixture_version: u64,
    /// Number of atoms.
    pub atoms: u32,
    /// Formula.
    pub formula: String,
    /// Kinetic temperature, K.
    pub temperature: Option<f64>,
    /// V/V₀.
    pub relative_volume: Option<f64>,
    /// Largest γ under the mixture that its walker saw.
    pub walker_gamma: Option<f64>,
    /// Largest γ under the selector's mixture at the decision, before the update.
    pub selector_gamma: Option<f64>,
    /// Largest γ under the original mixture.
    pub gamma: Option<f64>,
    /// Largest γ_nbr under the original mixture.
    pub gamma_nbr: Option<f64>,
    /// State of the newest label job of its structure; `None` without a job.
    pub job_state: Option<String>,
    /// Priority of that job.
    pub priority: Option<i32>,
    /// Attempts at that job.
    pub attempts: Option<u32>,
    /// What its label is worth; `None` in a queue in the order in which structures were found.
    pub value: Option<f64>,
    /// The factors of the value, a JSON object.
    pub value_factors: Option<serde_json::Value>,
    /// Energy by the potential of its walk, eV.
    pub potential_energy: Option<f64>,
    /// Energy of its structure's label under that job's protocol, eV; `None` without a label, or if the label is
    /// excluded.
    pub energy: Option<f64>,
    /// Largest force of that label, eV/Å.
    pub max_force: Option<f64>,
    /// Names of the retry adjustments with which it was made.
    pub retry_adjustments: Option<Vec<String>>,
}
