//! A walk, as the selector sees it.

use serde::{Deserialize, Serialize};
use store::records::{AssignmentRecord, Commit, TrajectoryPart, WalkRecord};
use wire::messages::{AssignmentReport, Verdict, WalkEnd, WalkProgress};
use wire::{Origin, WalkConditions, WalkId};

use super::error::SelectorError;

/// A walk: its stored record, decoded.
pub(super) struct Walk {
    pub record: WalkRecord,
    pub state: SelectorState,
}

/// State of a walk that the selector keeps between assignments.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct SelectorState {
    /// The decision on the candidate that ended the last assignment.
    pub verdict: Option<Verdict>,
    /// Segment at the end of the last completed assignment. An interrupted walk may be in a later one.
    pub segment: u32,
    /// Last step of the next assignment.
    pub until: u64,
    /// Control walk: steps of the remaining frames.
    pub wanted: Vec<u64>,
    /// Biased walk: steps at which structures were accepted.
    pub accepted_steps: Vec<u64>,
    /// Number of accepted steps for which a control walk exists.
    pub controlled: usize,
    /// Number of records of its assignments; `None` if the walk began under a version that kept none.
    #[serde(default)]
    pub records: Option<u64>,
}

impl Walk {
    pub fn new(walk: WalkId, seed_structure: u32, conditions: WalkConditions, until: u64) -> Self {
        let record = WalkRecord {
            walk,
            origin: Origin::Biased,
            partner: None,
            seed_structure,
            conditions,
            state: "waiting".to_owned(),
            reason: String::new(),
            assignments: 0,
            accepted: 0,
            progress: WalkProgress::default(),
            selector_state: String::new(),
            checkpoint: None,
        };
        Self { record, state: SelectorState { until, records: Some(0), ..SelectorState::default() } }
    }

    /// Whether it has accepted structures without a control walk.
    pub fn needs_control(&self) -> bool {
        self.is_biased() && self.has_ended() && self.state.controlled < self.state.accepted_steps.len()
    }

    /// The unbiased control of a biased walk, with frames at the steps where the biased walk collected.
    pub fn new_control(&mut self, walk: WalkId, steps_per_assignment: u64) -> Self {
        let mut control = Self::new(walk, self.record.seed_structure, self.record.conditions.clone(), 0);
        control.record.origin = Origin::Control;
        control.record.partner = Some(self.record.walk);
        let wanted = &mut control.state.wanted;
        wanted.extend(&self.state.accepted_steps[self.state.controlled..]);
        self.state.controlled = self.state.accepted_steps.len();
        wanted.sort_unstable();
        wanted.dedup();
        control.set_last_step(steps_per_assignment);
        control
    }

    pub fn restore(record: WalkRecord) -> Result<Self, SelectorError> {
        let state = serde_json::from_str(&record.selector_state).map_err(|error| {
            SelectorError::Snapshot(format!("state of walk {} is damaged: {error}", record.walk))
        })?;
        Ok(Self { record, state })
    }

    pub fn to_record(&self) -> WalkRecord {
        let selector_state = serde_json::to_string(&self.state).expect("plain data becomes JSON");
        WalkRecord { selector_state, ..self.record.clone() }
    }

    pub fn is_biased(&self) -> bool {
        self.record.origin == Origin::Biased
    }

    pub fn has_ended(&self) -> bool {
        !matches!(self.record.state.as_str(), "waiting" | "running")
    }

    /// Sets the last step of the next assignment: after `steps_per_assignment` steps, or at a control walk's last frame
    /// if that is earlier.
    pub fn set_last_step(&mut self, steps_per_assignment: u64) {
        let until = self.record.progress.step + steps_per_assignment;
        self.state.until = self.state.wanted.last().map_or(until, |last| until.min(*last));
    }

    /// Step at the end of the last completed assignment, from which the next one counts. An interrupted walk is beyond it.
    pub fn counted_step(&self, steps_per_assignment: u64) -> u64 {
        self.state.until.saturating_sub(steps_per_assignment)
    }

    /// Whether a control walk is past its last frame without having provided it.
    pub fn missed_its_frames(&self) -> bool {
        self.state.wanted.last().is_some_and(|last| self.record.progress.step >= *last)
    }

    /// Records where an assignment was interrupted; it continues from there. The checkpoint already accounts for the
    /// verdict with which it started.
    pub fn interrupt<C>(&mut self, mut report: AssignmentReport<C>) -> Commit {
        let mut commit = Commit::default();
        self.record_assignment(&mut report, &mut commit);
        self.record.checkpoint = Some(report.checkpoint);
        self.record.progress = report.progress;
        self.state.verdict = None;
        commit.traces.push((self.record.walk, report.trace));
        commit.walks.push(self.to_record());
        commit
    }

    /// Adds to a commit what the store keeps of an assignment, or of the part of it that was interrupted, with the frames of its trajectory.
    /// Counts the records.
    pub fn record_assignment<C>(&mut self, report: &mut AssignmentReport<C>, commit: &mut Commit) {
        let (Some(start), Some(records)) = (report.start.clone(), self.state.records.as_mut()) else {
            return;
        };
        let part = *records;
        *records += 1;
        let (walk, number, end) = (self.record.walk, report.assignment, report.progress.position());
        commit.assignments.push(AssignmentRecord { walk, part, number, start, end });
        let frames = std::mem::take(&mut report.frames);
        if !frames.is_empty() {
            commit.trajectories.push(TrajectoryPart { walk, part, frames });
        }
    }

    /// Whether it ended only because of a limit.
    pub fn ended_by_budget(&self) -> bool {
        let ends = [WalkEnd::QuotaReached, WalkEnd::Budget, WalkEnd::NothingNew];
        self.is_biased() && ends.iter().any(|end| self.record.state == end.name())
    }

    /// Whether it made room for a new version of the potential.
    pub fn was_superseded(&self) -> bool {
        self.is_biased() && self.record.state == WalkEnd::Superseded.name()
    }
}

#[cfg(test)]
mod tests {
    use wire::messages::{AssignmentStart, Outcome, PathPosition};
    use wire::{CandidateBlock, WalkFrame};

    use super::*;

    const ORIGINS: [Origin; 2] = [Origin::Biased, Origin::Control];

    fn walk(origin: Origin, state: &str) -> Walk {
        let mut walk = Walk::new(WalkId(3), 0, WalkConditions::default(), 0);
        (walk.record.origin, walk.record.state) = (origin, state.to_owned());
        walk
    }

    #[test]
    fn only_ended_biased_walks_need_controls() {
        let needs = |origin, state: &str, controlled| {
            let mut walk = walk(origin, state);
            (walk.state.accepted_steps, walk.state.controlled) = (vec![10, 20], controlled);
            walk.needs_control()
        };
        assert!(needs(Origin::Biased, "completed", 0) && needs(Origin::Biased, "diverged", 1));
        assert!(!needs(Origin::Biased, "completed", 2), "each of its structures has one");
        assert!(!needs(Origin::Biased, "completed", 3));
        assert!(!needs(Origin::Biased, "running", 0) && !needs(Origin::Biased, "waiting", 0));
        assert!(!needs(Origin::Control, "completed", 0));
    }

    #[test]
    fn limits_end_biased_walks_that_could_go_on() {
        for end in [WalkEnd::QuotaReached, WalkEnd::Budget, WalkEnd::NothingNew] {
            assert_eq!(ORIGINS.map(|origin| walk(origin, end.name()).ended_by_budget()), [true, false]);
        }
        for end in [WalkEnd::Completed, WalkEnd::Superseded, WalkEnd::VolumeBoundary] {
            assert_eq!(ORIGINS.map(|origin| walk(origin, end.name()).ended_by_budget()), [false; 2]);
        }
        let superseded = |end: &WalkEnd| ORIGINS.map(|origin| walk(origin, end.name()).was_superseded());
        assert_eq!(superseded(&WalkEnd::Superseded), [true, false]);
        assert_eq!(superseded(&WalkEnd::Budget), [false; 2]);
    }

    #[test]
    fn an_assignment_ends_at_the_last_frame_of_a_control_walk() {
        let mut control = walk(Origin::Control, "running");
        control.record.progress.step = 100;
        control.set_last_step(50);
        assert_eq!(
            (control.state.until, control.counted_step(50), control.missed_its_frames()),
            (150, 100, false)
        );
        assert_eq!(control.counted_step(151), 0);
        control.state.wanted = vec![90, 120];
        control.set_last_step(50);
        assert_eq!((control.state.until, control.missed_its_frames()), (120, false));
        for (step, missed) in [(119, false), (120, true), (121, true)] {
            control.record.progress.step = step;
            assert_eq!(control.missed_its_frames(), missed);
        }
    }

    #[test]
    fn each_part_of_an_assignment_has_a_number() {
        let mut walk = walk(Origin::Biased, "running");
        let report = |start, frames| AssignmentReport::<CandidateBlock> {
            walk: WalkId(3),
            assignment: 7,
            start,
            outcome: Outcome::Interrupted,
            checkpoint: vec![1],
            progress: WalkProgress { step: 5, ..WalkProgress::default() },
            trace: Vec::new(),
            frames,
        };
        let position = PathPosition::default();
        let start =
            || Some(AssignmentStart { position, mixture_version: 0, threshold_factor: 1.0, verdict: None });
        let parts = |commit: &Commit| {
            let assignments: Vec<u64> = commit.assignments.iter().map(|assignment| assignment.part).collect();
            let trajectories: Vec<u64> = commit.trajectories.iter().map(|part| part.part).collect();
            (assignments, trajectories)
        };
        assert_eq!(parts(&walk.interrupt(report(start(), Vec::new()))), (vec![0], vec![]));
        // It made no step.
        assert_eq!(parts(&walk.interrupt(report(None, Vec::new()))), (vec![], vec![]));
        let commit = walk.interrupt(report(start(), vec![WalkFrame::default()]));
        assert_eq!(parts(&commit), (vec![1], vec![1]));
        assert_eq!(walk.state.records, Some(2));
        let stored = Walk::restore(commit.walks[0].clone()).unwrap();
        assert_eq!((stored.state, stored.record.progress.step), (walk.state.clone(), 5));
        walk.state.records = None;
        assert_eq!(parts(&walk.interrupt(report(start(), Vec::new()))), (vec![], vec![]));
    }
}
