//! The end of a walk that was run again, beside that of its record.

use store::WalkRecord;
use wire::Candidate;
use wire::messages::AssignmentReport;
use workers::walk::is_same_state;

/// What of the state after the last report is not as in the record of the walk. The record has no other state, and that of a walk that
/// diverged depends on which guard found it.
pub fn difference(record: &WalkRecord, report: &AssignmentReport<Candidate>) -> Option<String> {
    let (recorded, found) = (&record.progress, &report.progress);
    if record.state == "diverged" || recorded.position() != found.position() {
        return None;
    }
    let numbers = [
        ("τ", recorded.tau, found.tau),
        ("the temperature of the last step", recorded.temperature, found.temperature),
        ("the volume of the last step", recorded.relative_volume, found.relative_volume),
        ("γ_max of the last step", recorded.gamma_max, found.gamma_max),
    ];
    let counts = [
        ("the number of rejections", recorded.rejected, found.rejected),
        ("the number of roll backs", recorded.rollbacks.into(), found.rollbacks.into()),
    ];
    let numbers = numbers.into_iter().find(|(_, recorded, found)| recorded.to_bits() != found.to_bits());
    let counts = counts.into_iter().find(|(_, recorded, found)| recorded != found);
    let what = numbers.map(|(what, ..)| what).or(counts.map(|(what, ..)| what));
    // Checkpoints of other layouts cannot be compared.
    let is_same = |checkpoint: &Vec<u8>| is_same_state(checkpoint, &report.checkpoint) != Some(false);
    let what = what.or((!record.checkpoint.iter().all(is_same)).then_some("the last checkpoint"));
    what.map(|what| format!("{what} differs"))
}
