//! What a calculation is asked for.

use atoms::Structure;
use dft::FailureClass;
use store::records::Lease;

use super::label_progress::LabelProgress;

/// A structure to calculate, and what was tried before.
pub(super) struct CalculationRequest<'a> {
    pub structure: &'a Structure,
    /// Number of the job and of its attempt, for the name of the directory.
    pub job: i64,
    pub attempt: u32,
    /// Classes of the failures so far, oldest first.
    pub failures: Vec<FailureClass>,
    /// Calculations that may still be running or unread, newest first, as they were recorded.
    pub earlier: &'a [String],
    /// Calculations that failed.
    pub failed: &'a [String],
    pub record: CalculationNote<'a>,
}

/// Where a calculation is recorded before it starts.
#[derive(Clone, Copy)]
pub(super) enum CalculationNote<'a> {
    /// With the attempt of this lease.
    Lease(&'a Lease),
    /// In the progress of a label outside the queue, under this key.
    Progress(&'a str, &'a LabelProgress),
}
