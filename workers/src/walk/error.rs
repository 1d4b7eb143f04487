//! Errors.

use atoms::{PotentialError, StructureError};
use md::DynamicsError;
use potentials::ZblRangeError;

use crate::bias::UngradedError;

/// Why a walk cannot go on.
#[derive(Debug, thiserror::Error)]
pub(super) enum WalkError {
    #[error(transparent)]
    Dynamics(#[from] DynamicsError),
    #[error(transparent)]
    Potential(#[from] PotentialError),
    #[error(transparent)]
    Structure(#[from] StructureError),
    #[error(transparent)]
    Ungraded(#[from] UngradedError),
    #[error(transparent)]
    Zbl(#[from] ZblRangeError),
    #[error("the walk's checkpoint cannot be read: {0}")]
    Checkpoint(#[from] postcard::Error),
    #[error("{0}")]
    Diverged(String),
}
