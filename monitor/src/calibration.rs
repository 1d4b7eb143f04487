//! STUB: stands in for the module of task F, and is dropped at the merge.

use store::{Store, StoreError};
use wire::ContentHash;

/// STUB: nothing is calibrated.
#[derive(Clone, Debug, Default)]
pub struct CalibrationState {}

/// STUB: reads nothing.
pub async fn read(
    _store: &Store,
    _protocol: ContentHash,
    _version: u32,
) -> Result<CalibrationState, StoreError> {
    Ok(CalibrationState {})
}

impl CalibrationState {
    /// STUB: unknown.
    pub fn expected_error(&self, _gamma_nbr: f64) -> Option<f64> {
        None
    }
}
