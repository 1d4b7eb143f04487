//! One line for the user about each job.

use dft::{CalculationResults, Failure};
use store::records::Lease;
use store::{CompleteOutcome, FailOutcome};

/// The outcome of delivering a result.
pub(super) enum DeliveryOutcome {
    Completed(CompleteOutcome),
    Failed(FailOutcome),
}

/// Formats the line. For a label it begins with `labelled`.
pub(super) fn format_report(
    lease: &Lease,
    validated: &Result<CalculationResults, Failure>,
    outcome: &DeliveryOutcome,
    seconds: f64,
) -> String {
    let candidate = &lease.candidate;
    match (validated, outcome) {
        (Ok(label), DeliveryOutcome::Completed(CompleteOutcome::Label)) => {
            format!("labelled {candidate}: {:.4} eV, {seconds:.1} s", label.energy)
        }
        (Ok(_), _) => format!("{candidate} has a label already; this result is kept as a check"),
        (Err(failure), DeliveryOutcome::Failed(FailOutcome::Requeued)) => {
            format!("{candidate} failed and waits for another attempt: {failure}")
        }
        (Err(failure), DeliveryOutcome::Failed(FailOutcome::Failed)) => {
            format!("{candidate} has no attempts left: {failure}")
        }
        (Err(failure), _) => format!("{candidate} failed, and another labeller has it now: {failure}"),
    }
}
