//! Counters and connection state of an agent, for monitoring only.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use wire::WalkId;
use wire::messages::{Assignment, Outcome, WalkProgress};
use wire::net::SlotReport;

use super::UNRESPONSIVE_AFTER;

/// Counts since the agent started, and current values.
#[derive(Clone, Debug, Default)]
pub struct AgentMetrics {
    /// Assignments received from the orchestrator.
    pub assignments_received: u64,
    /// Outcomes of assignments that the orchestrator has accepted.
    pub assignments: AssignmentCounts,
    /// Steps made by walkers, including repeated ones. For a walk that ran elsewhere before, counting starts at its
    /// first progress report.
    pub steps: u64,
    /// Registrations with the orchestrator: more than one after a broken connection or a restart of the
    /// orchestrator.
    pub joins: u64,
    /// Reports that the orchestrator has not accepted yet.
    pub unsent: usize,
    /// Walkers without an assignment.
    pub idle: usize,
    /// The newest mixture version received with an assignment or at registration.
    pub mixture_version: Option<u64>,
    /// Round-trip time of the last query.
    pub round_trip: Option<Duration>,
    /// When the orchestrator last replied.
    pub heard: Option<Instant>,
    /// Last known position of each walk.
    walks: BTreeMap<WalkId, WalkPosition>,
}

/// Number of assignments by outcome.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct AssignmentCounts {
    /// Ended with a candidate, or with a frame of a control walk.
    pub candidate: u64,
    /// Ran to their last step.
    pub steps_done: u64,
    /// Stopped because the walker was asked to stop.
    pub interrupted: u64,
    /// Ended with the walk.
    pub ended: u64,
    /// Lost with their walker.
    pub lost: u64,
}

#[derive(Clone, Copy, Debug)]
struct WalkPosition {
    assignment: u64,
    /// Segment and step; `None` until the start of the assignment is known.
    at: Option<(u32, u64)>,
}

impl AgentMetrics {
    /// Whether the orchestrator responds.
    pub fn is_linked(&self) -> bool {
        self.heard.is_some_and(|heard| heard.elapsed() <= UNRESPONSIVE_AFTER)
    }

    /// Counts a received assignment with its mixture version.
    pub(super) fn received(&mut self, assignment: &Assignment, mixture_version: u64) {
        self.assignments_received += 1;
        self.mixture_version = self.mixture_version.max(Some(mixture_version));
        let before =
            self.walks.get(&assignment.walk).filter(|position| position.assignment + 1 == assignment.number);
        let at = match (&assignment.checkpoint, before) {
            (None, _) => Some((0, 0)),
            (Some(_), before) => before.and_then(|position| position.at),
        };
        self.walks.insert(assignment.walk, WalkPosition { assignment: assignment.number, at });
    }

    /// Records the progress of a walk.
    pub(super) fn record_progress(&mut self, walk: WalkId, progress: &WalkProgress) {
        let Some(position) = self.walks.get_mut(&walk) else { return };
        let now = (progress.segment, progress.step);
        // A roll back to a checkpoint is no step.
        if let Some((_, step)) = position.at.filter(|(segment, _)| *segment == now.0) {
            self.steps += now.1.saturating_sub(step);
        }
        position.at = Some(now);
    }

    /// Counts what the orchestrator has accepted.
    pub(super) fn delivered(&mut self, report: &SlotReport) {
        let counts = &mut self.assignments;
        let count = match report {
            SlotReport::Empty => return,
            SlotReport::Lost { .. } => &mut counts.lost,
            SlotReport::Report(report) => match report.outcome {
                Outcome::Candidate(_) => &mut counts.candidate,
                Outcome::StepsDone => &mut counts.steps_done,
                Outcome::Interrupted => &mut counts.interrupted,
                Outcome::Ended(_) => &mut counts.ended,
            },
        };
        *count += 1;
    }
}

#[cfg(test)]
mod tests {
    use atoms::{Cell, Structure};
    use wire::messages::{AssignmentReport, WalkEnd};
    use wire::{CampaignId, Origin, WalkConditions};

    use super::*;

    const WALK: WalkId = WalkId(3);

    fn assignment(number: u64, checkpoint: Option<Vec<u8>>) -> Assignment {
        let cell = Cell::orthorhombic(1.0, 1.0, 1.0);
        let seed_structure =
            Structure { species: Vec::new(), positions: Vec::new(), cell, periodic: [true; 3] };
        Assignment {
            campaign: CampaignId([1; 16]),
            walk: WALK,
            number,
            origin: Origin::Biased,
            random_walk: WALK,
            seed_structure,
            conditions: WalkConditions::default(),
            checkpoint,
            verdict: None,
            last_step: 100,
            frame_steps: Vec::new(),
            threshold_factor: 1.0,
        }
    }

    fn at(segment: u32, step: u64) -> WalkProgress {
        WalkProgress { segment, step, ..WalkProgress::default() }
    }

    #[test]
    fn steps_count_those_made_here() {
        let mut metrics = AgentMetrics::default();
        metrics.received(&assignment(0, None), 7);
        metrics.record_progress(WALK, &at(0, 10));
        metrics.record_progress(WALK, &at(0, 40));
        // It continues where it was.
        metrics.received(&assignment(1, Some(Vec::new())), 7);
        metrics.record_progress(WALK, &at(0, 45));
        assert_eq!(metrics.steps, 45);
        // It rolls back to step 20 and continues.
        metrics.record_progress(WALK, &at(1, 20));
        metrics.record_progress(WALK, &at(1, 25));
        assert_eq!(metrics.steps, 50);
        // It ran elsewhere for some assignments.
        metrics.received(&assignment(9, Some(Vec::new())), 7);
        metrics.record_progress(WALK, &at(1, 900));
        metrics.record_progress(WALK, &at(1, 901));
        assert_eq!((metrics.steps, metrics.assignments_received, metrics.mixture_version), (51, 3, Some(7)));
        metrics.record_progress(WalkId(4), &at(0, 7));
        assert_eq!(metrics.steps, 51, "no walker here has that walk");
    }

    #[test]
    fn assignments_are_counted_by_outcome() {
        let mut metrics = AgentMetrics::default();
        let report = |outcome| {
            let checkpoint = Vec::new();
            SlotReport::Report(Box::new(AssignmentReport {
                walk: WALK,
                assignment: 0,
                outcome,
                checkpoint,
                progress: at(0, 1),
                start: None,
                trace: Vec::new(),
                frames: Vec::new(),
            }))
        };
        let ended = || report(Outcome::Ended(WalkEnd::Completed));
        for sent in [
            SlotReport::Empty,
            report(Outcome::StepsDone),
            ended(),
            ended(),
            SlotReport::Lost { crashed: true },
        ] {
            metrics.delivered(&sent);
        }
        let expected = AssignmentCounts { steps_done: 1, ended: 2, lost: 1, ..AssignmentCounts::default() };
        assert_eq!(metrics.assignments, expected);
        assert!(!metrics.is_linked(), "it has never been heard");
        metrics.heard = Some(Instant::now());
        assert!(metrics.is_linked());
    }
}
