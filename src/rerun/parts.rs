//! The parts of a walk's path, from the records of its assignments.

use store::AssignmentRecord;

/// The records that the walk's path consists of, in order. A walker that seemed lost may have reported an interruption while another one
/// worked on the same assignment from its start: what the first one made is not part of the path.
pub fn made_parts(records: Vec<AssignmentRecord>) -> Vec<AssignmentRecord> {
    let mut parts = Vec::<AssignmentRecord>::new();
    for record in records {
        while parts.last().is_some_and(|last| is_repeated_by(last, &record)) {
            parts.pop();
        }
        parts.push(record);
    }
    parts
}

/// Whether a record begins before the end of an earlier one. One that made no step has used up the verdict.
fn is_repeated_by(earlier: &AssignmentRecord, later: &AssignmentRecord) -> bool {
    let has_verdict = earlier.start.verdict.is_some() && later.start.verdict.is_some();
    earlier.number == later.number && (earlier.end > later.start.position || has_verdict)
}

#[cfg(test)]
mod tests {
    use wire::WalkId;
    use wire::messages::{AssignmentStart, PathPosition, Verdict};

    use super::*;

    fn record(part: u64, number: u64, from: u64, to: u64, verdict: Option<Verdict>) -> AssignmentRecord {
        let at = |step| PathPosition { step, ..PathPosition::default() };
        let start =
            AssignmentStart { position: at(from), mixture_version: part, threshold_factor: 1.0, verdict };
        AssignmentRecord { walk: WalkId(0), part, number, start, end: at(to) }
    }

    fn made(records: &[(u64, u64, u64, bool)]) -> Vec<u64> {
        let records = records.iter().zip(0..);
        let records = records.map(|((number, from, to, verdict), part)| {
            record(part, *number, *from, *to, verdict.then_some(Verdict::Accepted))
        });
        made_parts(records.collect()).iter().map(|record| record.part).collect()
    }

    #[test]
    fn an_interrupted_assignment_goes_on_where_it_was() {
        assert_eq!(made(&[(0, 0, 40, false), (1, 40, 50, true), (1, 50, 80, false)]), [0, 1, 2]);
        // Without a step, but with the verdict.
        assert_eq!(made(&[(0, 0, 40, false), (1, 40, 40, true), (1, 40, 80, false)]), [0, 1, 2]);
    }

    #[test]
    fn what_a_walker_made_that_seemed_lost_is_left_out() {
        assert_eq!(made(&[(0, 0, 40, false), (1, 40, 50, true), (1, 40, 80, true)]), [0, 2]);
        assert_eq!(made(&[(0, 0, 40, false), (1, 40, 40, true), (1, 40, 80, true)]), [0, 2]);
        let twice =
            [(0, 0, 40, false), (1, 40, 50, true), (1, 50, 55, false), (1, 40, 80, true), (2, 80, 90, true)];
        assert_eq!(made(&twice), [0, 3, 4]);
    }
}
