//! The results of methods.

use dft::{CalculationResults, Failure};
use store::records::Lease;

use super::calculation_handle::CalculationHandle;
use super::energies::EnergyReference;
use super::validate::{LabelBounds, validate};

/// The result of a method.
pub(super) struct LabelAttempt {
    pub result: Result<CalculationResults, Failure>,
    /// Its calculation behind it, if it was a process of its own.
    pub ended: Option<EndedCalculation>,
}

impl LabelAttempt {
    /// The same, with an invalid result replaced by a failure.
    pub fn validated(
        self,
        lease: &Lease,
        bounds: &LabelBounds,
        expected: Option<EnergyReference<'_>>,
    ) -> Self {
        let result = self.result.and_then(|results| validate(results, &lease.structure, bounds, expected));
        Self { result, ..self }
    }
}

/// A calculation that has ended.
pub(super) struct EndedCalculation {
    pub core_seconds: f64,
    /// The end of the program's output.
    pub log: String,
    /// The node where it ran, for a batch job.
    pub node: Option<String>,
    pub handle: CalculationHandle,
}

/// The result of a single calculation.
#[derive(Clone, Debug)]
pub struct SingleLabel {
    /// Its numbers, validated like those of a campaign are.
    pub result: Result<CalculationResults, Failure>,
    /// The end of what the program said; empty for a potential.
    pub log: String,
    /// Cores times duration, s.
    pub core_seconds: f64,
}
