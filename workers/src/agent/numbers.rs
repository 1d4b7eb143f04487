//! What an agent has done and how its line is, for those who watch it. Decides nothing.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use wire::WalkId;
use wire::messages::{Assignment, Outcome, Progress};
use wire::net::SlotReport;

use super::SILENT;

/// Counts since the agent began, and how things stand.
#[derive(Clone, Debug, Default)]
pub struct Numbers {
    /// Turns that the orchestrator gave.
    pub turns_taken: u64,
    /// What came of turns, as far as the orchestrator has taken it.
    pub turns: Turns,
    /// Steps of walkers, also those that were made twice. Of a walk that was elsewhere before they are counted from the first
    /// that is heard of.
    pub steps: u64,
    /// Places that the orchestrator gave: more than one after a break of the line, or when it was started again.
    pub places: u64,
    /// Reports that the orchestrator has not taken yet.
    pub untold: usize,
    /// Walkers that wait for a turn.
    pub idle: usize,
    /// The newest version of the mixture that came with a turn, or with the place.
    pub mixture_version: Option<u64>,
    /// The time that the last question took to be answered.
    pub round_trip: Option<Duration>,
    /// When the orchestrator was last heard.
    pub heard: Option<Instant>,
    /// Where walks stood last.
    walks: BTreeMap<WalkId, Stand>,
}

/// Turns by what came of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Turns {
    /// They ended with a candidate, or with a frame of a control walk.
    pub candidate: u64,
    /// They were made to their last step.
    pub turn: u64,
    /// The walker was asked to stop.
    pub paused: u64,
    /// The walk is over.
    pub ended: u64,
    /// The walker was lost.
    pub lost: u64,
}

#[derive(Clone, Copy, Debug)]
struct Stand {
    turn: u64,
    /// Segment and step; none before it is known where the turn began.
    at: Option<(u32, u64)>,
}

impl Numbers {
    /// Whether the orchestrator answers.
    pub fn is_linked(&self) -> bool {
        self.heard.is_some_and(|heard| heard.elapsed() <= SILENT)
    }

    /// A turn has come, under this version of the mixture.
    pub(super) fn taken(&mut self, assignment: &Assignment, mixture_version: u64) {
        self.turns_taken += 1;
        self.mixture_version = self.mixture_version.max(Some(mixture_version));
        let before = self.walks.get(&assignment.walk).filter(|stand| stand.turn + 1 == assignment.number);
        let at = match (&assignment.checkpoint, before) {
            (None, _) => Some((0, 0)),
            (Some(_), before) => before.and_then(|stand| stand.at),
        };
        self.walks.insert(assignment.walk, Stand { turn: assignment.number, at });
    }

    /// A walk stands there.
    pub(super) fn at(&mut self, walk: WalkId, progress: &Progress) {
        let Some(stand) = self.walks.get_mut(&walk) else { return };
        let now = (progress.segment, progress.step);
        // A return to a checkpoint is no step.
        if let Some((_, step)) = stand.at.filter(|(segment, _)| *segment == now.0) {
            self.steps += now.1.saturating_sub(step);
        }
        stand.at = Some(now);
    }

    /// The orchestrator has taken this.
    pub(super) fn told(&mut self, told: &SlotReport) {
        let turns = &mut self.turns;
        let number = match told {
            SlotReport::Empty => return,
            SlotReport::Lost { .. } => &mut turns.lost,
            SlotReport::Report(report) => match report.outcome {
                Outcome::Candidate(_) => &mut turns.candidate,
                Outcome::StepsDone => &mut turns.turn,
                Outcome::Interrupted => &mut turns.paused,
                Outcome::Ended(_) => &mut turns.ended,
            },
        };
        *number += 1;
    }
}

#[cfg(test)]
mod tests {
    use atoms::{Cell, Structure};
    use wire::messages::{Report, WalkEnd};
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
            number: turn,
            origin: Origin::Biased,
            random_walk: WALK,
            seed_structure,
            checkpoint,
            verdict: None,
            last_step: 100,
            frame_steps: Vec::new(),
            threshold_factor: 1.0,
        }
    }

    fn at(segment: u32, step: u64) -> Progress {
        Progress { segment, step, ..Progress::default() }
    }

    #[test]
    fn steps_are_those_that_were_made_here() {
        let mut numbers = Numbers::default();
        numbers.taken(&turn(0, None), 7);
        numbers.at(WALK, &at(0, 10));
        numbers.at(WALK, &at(0, 40));
        // Goes on where it stood.
        numbers.taken(&turn(1, Some(Vec::new())), 7);
        numbers.at(WALK, &at(0, 45));
        assert_eq!(numbers.steps, 45);
        // It goes back to step 20, and on from there.
        numbers.at(WALK, &at(1, 20));
        numbers.at(WALK, &at(1, 25));
        assert_eq!(numbers.steps, 50);
        // It was elsewhere for some turns.
        numbers.taken(&turn(9, Some(Vec::new())), 7);
        numbers.at(WALK, &at(1, 900));
        numbers.at(WALK, &at(1, 901));
        assert_eq!((numbers.steps, numbers.turns_taken, numbers.mixture_version), (51, 3, Some(7)));
        numbers.at(WalkId(4), &at(0, 7));
        assert_eq!(numbers.steps, 51, "nobody works on that walk here");
    }

    #[test]
    fn turns_are_counted_by_what_came_of_them() {
        let mut numbers = Numbers::default();
        let report = |outcome| {
            let checkpoint = Vec::new();
            SlotReport::Report(Report { walk: WALK, assignment: 0, outcome, checkpoint, progress: at(0, 1) })
        };
        let ended = || report(Outcome::Ended(WalkEnd::Steps));
        for told in [
            SlotReport::Empty,
            report(Outcome::StepsDone),
            ended(),
            ended(),
            SlotReport::Lost { crashed: true },
        ] {
            numbers.told(&told);
        }
        let expected = Turns { turn: 1, ended: 2, lost: 1, ..Turns::default() };
        assert_eq!(numbers.turns, expected);
        assert!(!numbers.is_linked(), "it has never been heard");
        numbers.heard = Some(Instant::now());
        assert!(numbers.is_linked());
    }
}
