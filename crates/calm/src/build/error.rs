//! Why a build failed.

use crate::component::ComponentError;
use crate::linear::LinearError;
use crate::mixture::MixtureError;

/// Input that no mixture can be built from.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BuildError {
    /// A feature dimension of zero.
    #[error("a build needs at least one feature dimension")]
    NoFeature,
    /// An element without centroids, which is one without atoms in pass 1.
    #[error("the element has no centroid; pass 1 found no atoms of it")]
    NoCentroid,
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
    /// A feature that is infinite, undefined or too large to be squared.
    #[error(
        "features of atom {atom} of the batch: found a sum of squares of {found}, expected a finite number"
    )]
    Features {
        /// Index of the atom in the batch.
        atom: usize,
        /// Its sum of squares.
        found: f64,
    },
    /// A weight that is negative, infinite or undefined.
    #[error(
        "weight of atom {atom} of the batch: found {found}, expected a finite number that is not negative"
    )]
    Weight {
        /// Index of the atom in the batch.
        atom: usize,
        /// Its weight.
        found: f64,
    },
    /// Unusable candidates for the number of clusters.
    #[error(
        "candidates for the number of clusters: found {found:?}, expected at least one, ascending, from 1"
    )]
    Candidates {
        /// The candidates.
        found: Vec<usize>,
    },
    /// A partial result of another build, element or pass.
    #[error("partial result of a shard: {what} is {found}, expected {expected}; was it made by this build?")]
    Partial {
        /// What differs.
        what: &'static str,
        /// Its value.
        found: u64,
        /// The value of the results before it.
        expected: u64,
    },
    /// A sum over the training data that is too large, or that is no number.
    #[error(
        "a sum over the training data is {found:e}, expected a number between ±1.4e17; are weights or features too large?"
    )]
    Sum {
        /// The sum, or the term that makes it so.
        found: f64,
    },
    /// A covariance that cannot be inverted.
    #[error("covariance of component {slot}: {source}")]
    Linear {
        /// Component index.
        slot: usize,
        /// What failed.
        source: LinearError,
    },
    /// Numbers that are not a valid component.
    #[error("component {slot} of element {element}: {source}")]
    Component {
        /// Element index.
        element: usize,
        /// Component index.
        slot: usize,
        /// What is wrong with it.
        source: ComponentError,
    },
    /// Components that are not a valid mixture.
    #[error(transparent)]
    Mixture(#[from] MixtureError),
}

/// Checks a length.
pub(super) fn expect_length(what: &'static str, found: usize, expected: usize) -> Result<(), BuildError> {
    if found == expected { Ok(()) } else { Err(BuildError::Length { what, found, expected }) }
}

/// Checks the weights of a batch.
pub(super) fn expect_weights(weights: &[f64], atoms: usize) -> Result<(), BuildError> {
    expect_length("weights", weights.len(), atoms)?;
    match weights.iter().position(|weight| !(weight.is_finite() && *weight >= 0.0)) {
        Some(atom) => Err(BuildError::Weight { atom, found: weights[atom] }),
        None => Ok(()),
    }
}

/// Checks that a partial result belongs to those before it.
pub(super) fn expect_same(what: &'static str, found: u64, expected: u64) -> Result<(), BuildError> {
    if found == expected { Ok(()) } else { Err(BuildError::Partial { what, found, expected }) }
}
