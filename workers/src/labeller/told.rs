//! What came of a leased job, as a line for people.

use dft::{Failure, Results};
use store::records::Lease;
use store::{Completed, Failed};

/// What became of the job when the result was brought.
pub(super) enum Became {
    Completed(Completed),
    Failed(Failed),
}

/// The line. One for a label begins with `labelled`.
pub(super) fn line(
    lease: &Lease,
    judged: &Result<Results, Failure>,
    became: &Became,
    seconds: f64,
) -> String {
    let candidate = &lease.candidate;
    match (judged, became) {
        (Ok(label), Became::Completed(Completed::Label)) => {
            format!("labelled {candidate}: {:.4} eV, {seconds:.1} s", label.energy)
        }
        (Ok(_), _) => format!("{candidate} had its label already; this one is kept as a check"),
        (Err(failure), Became::Failed(Failed::Requeued)) => {
            format!("{candidate} failed and waits for another attempt: {failure}")
        }
        (Err(failure), Became::Failed(Failed::GivenUp)) => format!("{candidate} is given up: {failure}"),
        (Err(failure), _) => format!("{candidate} failed, and somebody else has it by now: {failure}"),
    }
}
