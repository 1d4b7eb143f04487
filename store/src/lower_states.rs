//! Two magnetic states of one structure: its label, and another result by the same protocol with a lower energy.

use serde::{Deserialize, Serialize};

use crate::jobs::{LabelRecord, LabelStatus};

/// What happens when two states of a structure are known.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OnLowerState {
    /// The lower one is proposed; the user decides ([`crate::Store::take_lower_states`]).
    #[default]
    Propose,
    /// The lower one becomes the label when a result arrives.
    Supersede,
}

/// When a result is another state than the label, and what happens then.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct LowerStateRule {
    /// Results that differ by less are the same state, eV/atom.
    pub min_difference: f64,
    /// What happens.
    pub on_lower_state: OnLowerState,
}

impl Default for LowerStateRule {
    fn default() -> Self {
        Self { min_difference: 0.001, on_lower_state: OnLowerState::default() }
    }
}

/// A result for a structure, as one of its states.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StateResult {
    /// Its status.
    pub status: LabelStatus,
    /// Its origin, as text.
    pub source: String,
    /// Energy per atom, eV.
    pub energy_per_atom: f64,
    /// Magnetic moment of the cell, μ_B.
    pub magnetisation: Option<f64>,
    /// Names of the retry adjustments of its calculation.
    pub retry_adjustments: Vec<String>,
    /// Whether its calculation started from other magnetic moments than the protocol's.
    pub changed_moments: bool,
}

/// A structure whose label is not the lowest known state.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LowerState {
    /// Name of the first candidate with that structure, or `import-N`.
    pub id: String,
    /// Name of the protocol.
    pub protocol: String,
    /// Number of atoms.
    pub atoms: u32,
    /// Energy of the lower state less that of the label, per atom, eV.
    pub difference_per_atom: f64,
    /// The label.
    pub label: StateResult,
    /// The lowest other result by the same protocol.
    pub lower: StateResult,
}

/// The effect of making lower states the labels, for one structure.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LowerStateChange {
    /// Name of the candidate, or `import-N`.
    pub id: String,
    /// The lower states that became labels; `label` is what they superseded. Empty if no result is lower.
    pub taken: Vec<LowerState>,
}

impl StateResult {
    pub(crate) fn new(record: &LabelRecord) -> Self {
        let details = &record.label.details;
        Self {
            status: record.status,
            source: record.source.to_string(),
            energy_per_atom: record.label.energy / record.label.forces.len().max(1) as f64,
            magnetisation: details.magnetisation,
            retry_adjustments: details.retry_adjustments.clone(),
            changed_moments: details.has_changed_moments(),
        }
    }
}

/// Why a label was superseded by a state that is lower by `difference_per_atom` (negative, eV).
pub(crate) fn reason_of(difference_per_atom: f64) -> String {
    let digits = format!("{:.6}", difference_per_atom.abs());
    format!("a lower state: −{} eV/atom", digits.trim_end_matches('0').trim_end_matches('.'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reasons_have_the_digits_that_matter() {
        for (difference, expected) in [(-0.123, "−0.123"), (-2.0, "−2"), (-0.001_234_56, "−0.001235")] {
            assert_eq!(reason_of(difference), format!("a lower state: {expected} eV/atom"));
        }
    }
}
