//! What can be wrong with the input of a baseline.

use super::kind::BaselineKind;
use crate::linear::{LinearError, row_dots};

/// Why a baseline cannot be built or cannot score.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BaselineError {
    /// An array of the wrong length.
    #[error("{what}: found {found} numbers, expected {expected}")]
    Length {
        /// Which array.
        what: &'static str,
        /// Its length.
        found: usize,
        /// The length that fits the other arguments.
        expected: usize,
    },
    /// An element that the baseline does not have.
    #[error("atom {atom} has element index {element}, the baseline has {elements} elements")]
    Element {
        /// Atom index.
        atom: usize,
        /// Its element index.
        element: usize,
        /// Number of elements.
        elements: usize,
    },
    /// A feature that is infinite, undefined or too large to be squared.
    #[error("features of atom {atom}: found a sum of squares of {found}, expected a finite number")]
    Features {
        /// Atom index.
        atom: usize,
        /// Its sum of squares.
        found: f64,
    },
    /// A setting that is out of range.
    #[error("{what}: found {found}, expected {expected}")]
    Setting {
        /// Which setting.
        what: &'static str,
        /// Its value.
        found: f64,
        /// Its range.
        expected: &'static str,
    },
    /// A kind that needs a mixture.
    #[error("{kind} needs a mixture of the same features")]
    NoMixture {
        /// The kind.
        kind: BaselineKind,
    },
    /// A mixture that does not fit the features.
    #[error("the mixture has {found} {what}, expected {expected}")]
    Mixture {
        /// What differs.
        what: &'static str,
        /// Its value in the mixture.
        found: usize,
        /// The value that fits.
        expected: usize,
    },
    /// A mixture without counts and covariances.
    #[error(
        "the mixture has no counts and covariances, from which its density follows: expected that of an artifact"
    )]
    NoStatistics,
    /// No training data at all.
    #[error("the training data have no atoms")]
    NoData,
    /// Linear algebra that failed.
    #[error(transparent)]
    Linear(#[from] LinearError),
}

/// Why a baseline does not belong to a model.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the baselines belong to another model: their {what} is {baselines}, the model's is {model}")]
pub struct OriginMismatch {
    /// What differs.
    pub what: &'static str,
    /// Its value in the file of baselines.
    pub baselines: String,
    /// Its value in the model.
    pub model: String,
}

/// Checks the lengths of a batch, and that its features are finite and can be squared.
pub(super) fn check(dimension: usize, elements: &[usize], features: &[f64]) -> Result<(), BaselineError> {
    let expected = elements.len() * dimension;
    if features.len() != expected {
        return Err(BaselineError::Length { what: "features", found: features.len(), expected });
    }
    check_finite(dimension, features)
}

/// Checks rows of D numbers.
pub(super) fn check_rows(dimension: usize, multiple: usize, rows: &[f64]) -> Result<(), BaselineError> {
    let of_atom = dimension * multiple;
    if !rows.len().is_multiple_of(of_atom) {
        let expected = rows.len().next_multiple_of(of_atom);
        return Err(BaselineError::Length { what: "rows of force components", found: rows.len(), expected });
    }
    check_finite(dimension, rows)
}

fn check_finite(dimension: usize, features: &[f64]) -> Result<(), BaselineError> {
    let mut lengths = Vec::new();
    row_dots(features, features, dimension, &mut lengths);
    match lengths.iter().position(|length| !length.is_finite()) {
        Some(atom) => Err(BaselineError::Features { atom, found: lengths[atom] }),
        None => Ok(()),
    }
}

/// Checks the index of an element.
pub(super) fn check_element(atom: usize, element: usize, elements: usize) -> Result<(), BaselineError> {
    if element < elements { Ok(()) } else { Err(BaselineError::Element { atom, element, elements }) }
}
