//! The force errors that a candidate was expected to have, and whether its label agrees.

use serde::Serialize;
use store::{Store, StoreError};
use wire::ContentHash;

use super::learning::{ArrivedLabel, ArrivedLabels};
use super::{CALIBRATION, CalibrationState};
use crate::candidate_details::{CandidateDetails, GradedAtom};

/// Bounds of a candidate's force errors from the labels that came before its own; from all labels without one.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ExpectedErrors {
    /// Share of errors that are to be below the bound.
    pub level: f64,
    /// Labelled structures from which the bounds follow.
    pub structures: u64,
    /// Whether the queue chose these by value.
    pub by_value: bool,
    /// The atom with the largest γ_nbr under the original mixture.
    pub worst: AtomErrorBound,
    /// Share of the candidate's atoms with a bound whose error was not above it. `None` without a label or bounds.
    pub held: Option<f64>,
}

/// An atom with its bound.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AtomErrorBound {
    /// Its index, from 0.
    pub atom: usize,
    /// Its element.
    pub element: &'static str,
    /// γ_nbr under the original mixture.
    pub gamma_nbr: f64,
    /// The bound of |ΔF|, eV/Å. `None` without enough labels in the bin.
    pub bound: Option<f64>,
    /// |ΔF| against the label, eV/Å.
    pub error: Option<f64>,
}

/// Reads the labels of the candidate's version under the protocol in force, up to the candidate's own. `None` for structures without
/// grades, and without a protocol.
pub async fn expected_errors(
    store: &Store,
    details: &CandidateDetails,
) -> Result<Option<ExpectedErrors>, StoreError> {
    let (Some(found), Some(grades)) = (&details.found, &details.grades) else { return Ok(None) };
    let Some(protocol) = store.protocol_in_force().await? else { return Ok(None) };
    let grade = |atom: &GradedAtom| atom.gamma_nbr_original.filter(|grade| grade.is_finite());
    let graded = grades.atoms.iter().filter_map(|atom| Some((atom, grade(atom)?)));
    let Some((worst, gamma_nbr)) = graded.max_by(|a, b| a.1.total_cmp(&b.1)) else { return Ok(None) };
    let (before, own) = before_label(store, protocol.hash, found.version, &details.structure.hash).await?;
    // A label is compared with those that were chosen in the same way.
    let by_value = match &own {
        Some(own) => own.ordered_by_value,
        None => before.is_by_value_at(gamma_nbr),
    };
    let map = if by_value { &before.by_value } else { &before.found };
    let error = own.as_ref().and_then(|own| own.atoms.get(worst.atom)).map(|atom| atom.error);
    let bound = map.bound(gamma_nbr, Some(&worst.element));
    let held = |own: &ArrivedLabel| {
        let held =
            own.atoms.iter().filter_map(|atom| Some(atom.error <= map.bound(atom.grade, Some(&atom.group))?));
        let (atoms, below) =
            held.fold((0_u32, 0_u32), |(atoms, below), held| (atoms + 1, below + u32::from(held)));
        (atoms > 0).then(|| f64::from(below) / f64::from(atoms))
    };
    Ok(Some(ExpectedErrors {
        level: CALIBRATION.level,
        structures: map.structures(),
        by_value,
        worst: AtomErrorBound { atom: worst.atom, element: worst.element, gamma_nbr, bound, error },
        held: own.as_ref().and_then(held),
    }))
}

/// The calibration before the label of the structure with this hash came, and the labelled structure.
async fn before_label(
    store: &Store,
    protocol: ContentHash,
    version: u32,
    content: &str,
) -> Result<(CalibrationState, Option<ArrivedLabel>), StoreError> {
    let mut labelled = ArrivedLabels::new(store, protocol, version);
    let mut state = CalibrationState::new(version);
    while let Some(structure) = labelled.next().await? {
        if structure.content.to_string() == content {
            return Ok((state, Some(structure)));
        }
        state.learn(&structure);
    }
    Ok((state, None))
}
