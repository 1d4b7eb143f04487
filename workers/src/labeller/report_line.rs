//! What came of a leased job, as a line for people.

use dft::{Calculated, Failure};
use store::records::Lease;
use store::{CompleteOutcome, FailOutcome};

/// What became of the job when the result was brought.
pub(super) enum DeliveryOutcome {
    Completed(CompleteOutcome),
    Failed(FailOutcome),
}

/// The line. One for a label begins with `labelled`.
pub(super) fn format_report(
    lease: &Lease,
    validated: &Result<Calculated, Failure>,
    became: &DeliveryOutcome,
    seconds: f64,
) -> String {
    let candidate = &lease.candidate;
    match (validated, became) {
        (Ok(label), DeliveryOutcome::Completed(CompleteOutcome::Label)) => {
            format!("labelled {candidate}: {:.4} eV, {seconds:.1} s", label.energy)
        }
        (Ok(_), _) => format!("{candidate} had its label already; this one is kept as a check"),
        (Err(failure), DeliveryOutcome::Failed(FailOutcome::Requeued)) => {
            format!("{candidate} failed and waits for another attempt: {failure}")
        }
        (Err(failure), DeliveryOutcome::Failed(FailOutcome::GivenUp)) => {
            format!("{candidate} is given up: {failure}")
        }
        (Err(failure), _) => format!("{candidate} failed, and somebody else has it by now: {failure}"),
    }
}
