//! Summaries of recent decisions.

use wire::Origin;

/// A summary of a decision.
#[derive(Clone, Debug, PartialEq)]
pub struct RecentDecision {
    /// Its number.
    pub sequence: i64,
    /// See [`crate::Decision`].
    pub kind: String,
    /// The walk, if it is about one.
    pub walk: Option<u32>,
    /// Version of the mixture after it.
    pub mixture_version: u64,
    /// Its details, if it concerns no candidate; null otherwise.
    pub detail: serde_json::Value,
    /// The candidate, if it is about one.
    pub candidate: Option<DecidedCandidate>,
}

/// The candidate of a decision.
#[derive(Clone, Debug, PartialEq)]
pub struct DecidedCandidate {
    /// Its name.
    pub candidate: String,
    /// Biased or control.
    pub origin: Origin,
    /// Why it was declined; `None` if it was not.
    pub reason: Option<String>,
    /// Step of its walk, equilibration included.
    pub step: u64,
    /// Name of its seed structure.
    pub seed_structure: String,
    /// Number of atoms.
    pub atoms: u32,
    /// Formula.
    pub formula: String,
    /// Kinetic temperature, K.
    pub temperature: Option<f64>,
    /// V/V₀.
    pub relative_volume: Option<f64>,
    /// Largest γ under the selector's mixture, before the update.
    pub selector_gamma: Option<f64>,
    /// Largest γ under the original mixture.
    pub original_gamma: Option<f64>,
    /// Largest γ_nbr under the original mixture.
    pub original_gamma_nbr: Option<f64>,
}
