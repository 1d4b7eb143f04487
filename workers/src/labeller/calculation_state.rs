//! The state of a calculation.

use super::calculation_runner::CalculationEnd;

/// The state of a calculation.
#[derive(Debug, PartialEq)]
pub(super) enum CalculationState {
    /// It has ended, and its results can be read.
    Ended(CalculationEnd),
    Running,
    /// It is prepared and can be started.
    Ready,
    /// It was interrupted, or its directory was removed.
    Gone,
    /// It cannot be observed from this host.
    Elsewhere,
}
