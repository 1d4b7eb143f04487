//! Errors.

use atoms::{PotentialError, StructureError};
use md::DynamicsError;
use potentials::ZblRangeError;

use crate::bias::UngradedError;

/// Why a walk cannot continue.
#[derive(Debug, thiserror::Error)]
pub(super) enum WalkError {
    #[error(transparent)]
    Dynamics(DynamicsError),
    #[error(transparent)]
    Potential(PotentialError),
    /// The program that evaluates the potential does not answer any more; the walk is not at fault.
    #[error("{0}")]
    Unavailable(String),
    #[error(transparent)]
    Structure(#[from] StructureError),
    #[error(transparent)]
    Ungraded(UngradedError),
    #[error(transparent)]
    Zbl(#[from] ZblRangeError),
    #[error("the walk's checkpoint cannot be read: {0}")]
    Checkpoint(#[from] postcard::Error),
    #[error("the walk's checkpoint cannot be read: another version of calmwalk wrote it")]
    CheckpointLayout,
    #[error(
        "the bulk modulus of the seed structure is {0:.1} GPa: it is not stable; give walk.cell_bias.stress_scale"
    )]
    BulkModulus(f64),
    #[error("{0}")]
    Diverged(String),
}

impl From<PotentialError> for WalkError {
    fn from(error: PotentialError) -> Self {
        match error {
            PotentialError::Unavailable(reason) => Self::Unavailable(reason),
            other => Self::Potential(other),
        }
    }
}

impl From<DynamicsError> for WalkError {
    fn from(error: DynamicsError) -> Self {
        match error {
            DynamicsError::Potential(PotentialError::Unavailable(reason)) => Self::Unavailable(reason),
            other => Self::Dynamics(other),
        }
    }
}

impl From<UngradedError> for WalkError {
    fn from(error: UngradedError) -> Self {
        match error {
            UngradedError::Potential(PotentialError::Unavailable(reason)) => Self::Unavailable(reason),
            other => Self::Ungraded(other),
        }
    }
}
