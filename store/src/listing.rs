//! Candidates as a table: pages of it, in an order that has an index.

use serde::Serialize;

/// By what candidates are in order. Where several have the same, by decision.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ListOrder {
    /// As they were decided.
    Decision,
    /// Largest γ under the original mixture. Those without a finite one are left out.
    Gamma,
    /// V/V₀. Those without one are left out.
    Volume,
}

/// Where a page ends: the value that it is ordered by, and the decision.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ListCursor {
    /// γ or V/V₀; of any other order, anything.
    pub value: f64,
    /// Number of the decision.
    pub decision: i64,
}

/// A line of the table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ListedCandidate {
    /// Number of the decision about it.
    pub decision: i64,
    /// Its name.
    pub id: String,
    /// `biased` or `control`.
    pub origin: String,
    /// `accepted`, or why it was declined.
    pub fate: String,
    /// Number of its walk.
    pub walk: u32,
    /// Piece of the walk between two returns to a checkpoint.
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
    /// Largest γ under the original mixture.
    pub gamma: Option<f64>,
    /// Largest γ_nbr under the original mixture.
    pub gamma_nbr: Option<f64>,
    /// State of the newest label job of its structure; none if there is no job.
    pub job_state: Option<String>,
    /// Priority of that job.
    pub priority: Option<i32>,
    /// Attempts at that job.
    pub attempts: Option<u32>,
    /// Energy of its structure's label under that job's protocol, eV; none without a label, or if it is excluded.
    pub energy: Option<f64>,
    /// Largest force of that label, eV/Å.
    pub max_force: Option<f64>,
}
