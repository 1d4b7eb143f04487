//! What an agent has done and how its line is, for those who watch it. Decides nothing.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use wire::WalkId;
use wire::messages::{Assignment, Outcome, Progress};
use wire::net::Told;

use super::UNRESPONSIVE_AFTER;

/// Counts since the agent began, and how things stand.
#[derive(Clone, Debug, Default)]
pub struct AgentMetrics {
    /// Turns that the orchestrator gave.
    pub assignments_received: u64,
    /// What came of turns, as far as the orchestrator has taken it.
    pub assignments: AssignmentCounts,
    /// Steps of walkers, also those that were made twice. Of a walk that was elsewhere before they are counted from the first
    /// that is heard of.
    pub steps: u64,
    /// Places that the orchestrator gave: more than one after a break of the line, or when it was started again.
    pub joins: u64,
    /// Reports that the orchestrator has not taken yet.
    pub unsent: usize,
    /// Walkers that wait for a turn.
    pub idle: usize,
    /// The newest version of the mixture that came with a turn, or with the place.
    pub mixture_version: Option<u64>,
    /// The time that the last question took to be answered.
    pub round_trip: Option<Duration>,
    /// When the orchestrator was last heard.
    pub heard: Option<Instant>,
    /// Where walks stood last.
    walks: BTreeMap<WalkId, WalkPosition>,
}

/// Turns by what came of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct AssignmentCounts {
    /// They ended with a candidate, or with a frame of a control walk.
    pub candidate: u64,
    /// They were made to their last step.
    pub steps_done: u64,
    /// The walker was asked to stop.
    pub paused: u64,
    /// The walk is over.
    pub ended: u64,
    /// The walker was lost.
    pub lost: u64,
}

#[derive(Clone, Copy, Debug)]
struct WalkPosition {
    turn: u64,
    /// Segment and step; none before it is known where the turn began.
    at: Option<(u32, u64)>,
}

impl AgentMetrics {
    /// Whether the orchestrator answers.
    pub fn is_linked(&self) -> bool {
        self.heard.is_some_and(|heard| heard.elapsed() <= UNRESPONSIVE_AFTER)
    }

    /// A turn has come, under this version of the mixture.
    pub(super) fn received(&mut self, assignment: &Assignment, mixture_version: u64) {
        self.assignments_received += 1;
        self.mixture_version = self.mixture_version.max(Some(mixture_version));
        let before = self.walks.get(&assignment.walk).filter(|position| position.turn + 1 == assignment.turn);
        let at = match (&assignment.checkpoint, before) {
            (None, _) => Some((0, 0)),
            (Some(_), before) => before.and_then(|position| position.at),
        };
        self.walks.insert(assignment.walk, WalkPosition { turn: assignment.turn, at });
    }

    /// A walk stands there.
    pub(super) fn record_progress(&mut self, walk: WalkId, progress: &Progress) {
        let Some(position) = self.walks.get_mut(&walk) else { return };
        let now = (progress.segment, progress.step);
        // A return to a checkpoint is no step.
        if let Some((_, step)) = position.at.filter(|(segment, _)| *segment == now.0) {
            self.steps += now.1.saturating_sub(step);
        }
        position.at = Some(now);
    }

    /// The orchestrator has taken this.
    pub(super) fn delivered(&mut self, told: &Told) {
        let counts = &mut self.assignments;
        let count = match told {
            Told::Nothing => return,
            Told::Lost { .. } => &mut counts.lost,
            Told::Report(report) => match report.outcome {
                Outcome::Candidate(_) => &mut counts.candidate,
                Outcome::Turn => &mut counts.steps_done,
                Outcome::Paused => &mut counts.paused,
                Outcome::Ended(_) => &mut counts.ended,
            },
        };
        *count += 1;
    }
}

#[cfg(test)]
mod tests {
    use atoms::{Cell, Structure};
    use wire::messages::{End, Report};
    use wire::{CampaignId, Origin};

    use super::*;

    const WALK: WalkId = WalkId(3);

    fn turn(turn: u64, checkpoint: Option<Vec<u8>>) -> Assignment {
        let cell = Cell::orthorhombic(1.0, 1.0, 1.0);
        let seed_structure =
            Structure { species: Vec::new(), positions: Vec::new(), cell, periodic: [true; 3] };
        Assignment {
            campaign: CampaignId([1; 16]),
            walk: WALK,
            turn,
            origin: Origin::Biased,
            random_walk: WALK,
            seed_structure,
            checkpoint,
            verdict: None,
            until: 100,
            wanted: Vec::new(),
            raised: 1.0,
        }
    }

    fn at(segment: u32, step: u64) -> Progress {
        Progress { segment, step, ..Progress::default() }
    }

    #[test]
    fn steps_are_those_that_were_made_here() {
        let mut metrics = AgentMetrics::default();
        metrics.received(&turn(0, None), 7);
        metrics.record_progress(WALK, &at(0, 10));
        metrics.record_progress(WALK, &at(0, 40));
        // Goes on where it stood.
        metrics.received(&turn(1, Some(Vec::new())), 7);
        metrics.record_progress(WALK, &at(0, 45));
        assert_eq!(metrics.steps, 45);
        // It goes back to step 20, and on from there.
        metrics.record_progress(WALK, &at(1, 20));
        metrics.record_progress(WALK, &at(1, 25));
        assert_eq!(metrics.steps, 50);
        // It was elsewhere for some turns.
        metrics.received(&turn(9, Some(Vec::new())), 7);
        metrics.record_progress(WALK, &at(1, 900));
        metrics.record_progress(WALK, &at(1, 901));
        assert_eq!((metrics.steps, metrics.assignments_received, metrics.mixture_version), (51, 3, Some(7)));
        metrics.record_progress(WalkId(4), &at(0, 7));
        assert_eq!(metrics.steps, 51, "nobody works on that walk here");
    }

    #[test]
    fn turns_are_counted_by_what_came_of_them() {
        let mut metrics = AgentMetrics::default();
        let report = |outcome| {
            let checkpoint = Vec::new();
            Told::Report(Report { walk: WALK, turn: 0, outcome, checkpoint, progress: at(0, 1) })
        };
        let ended = || report(Outcome::Ended(End::Steps));
        for told in [Told::Nothing, report(Outcome::Turn), ended(), ended(), Told::Lost { fault: true }] {
            metrics.delivered(&told);
        }
        let expected = AssignmentCounts { steps_done: 1, ended: 2, lost: 1, ..AssignmentCounts::default() };
        assert_eq!(metrics.assignments, expected);
        assert!(!metrics.is_linked(), "it has never been heard");
        metrics.heard = Some(Instant::now());
        assert!(metrics.is_linked());
    }
}
