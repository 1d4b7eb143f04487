//! One walk as the selector sees it.

use serde::{Deserialize, Serialize};
use store::records::WalkRecord;
use wire::messages::{Progress, Report, Verdict, WalkEnd};
use wire::{Origin, WalkId};

use super::SelectorError;

/// A walk: what the store holds of it, and whether a walker has it in hand.
pub(super) struct Walk {
    pub record: WalkRecord,
    pub state: SelectorState,
    /// A walker works on its turn.
    pub is_assigned: bool,
}

/// What the selector itself remembers of a walk from one turn to the next.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct SelectorState {
    /// The answer to the candidate that the last turn ended with.
    pub verdict: Option<Verdict>,
    /// Segment of the last turn that ended; the walk may be further since, if it was interrupted.
    pub segment: u32,
    /// Last step of the turn.
    pub until: u64,
    /// Control walk: steps whose frames are still wanted.
    pub wanted: Vec<u64>,
    /// Biased walk: steps at which structures were accepted.
    pub accepted_steps: Vec<u64>,
    /// Of them, those whose control frames a control walk was begun for.
    pub controlled: usize,
}

impl Walk {
    pub fn new(walk: WalkId, seed_structure: u32, until: u64) -> Self {
        let record = WalkRecord {
            walk,
            origin: Origin::Biased,
            partner: None,
            seed_structure,
            state: "waiting".to_owned(),
            reason: String::new(),
            turn: 0,
            accepted: 0,
            progress: Progress::default(),
            selector_state: String::new(),
            checkpoint: None,
        };
        Self { record, state: SelectorState { until, ..SelectorState::default() }, is_assigned: false }
    }

    /// Whether structures were accepted from it that no control walk was begun for.
    pub fn needs_control(&self) -> bool {
        self.is_biased() && self.has_ended() && self.state.controlled < self.state.accepted_steps.len()
    }

    /// The unbiased control of a biased walk: frames at the steps at which that one collected.
    pub fn control(&mut self, walk: WalkId, steps_per_assignment: u64) -> Self {
        let mut control = Self::new(walk, self.record.seed_structure, 0);
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
        Ok(Self { record, state, is_assigned: false })
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

    /// The next turn ends after `steps_per_assignment` at the latest, that of a control walk at its last wanted frame.
    pub fn set_last_step(&mut self, steps_per_assignment: u64) {
        let until = self.record.progress.step + steps_per_assignment;
        self.state.until = self.state.wanted.last().map_or(until, |last| until.min(*last));
    }

    /// Whether a control walk has passed its last wanted frame without giving it.
    pub fn missed_its_frames(&self) -> bool {
        self.state.wanted.last().is_some_and(|last| self.record.progress.step >= *last)
    }

    /// Keeps where a turn was interrupted: the same turn goes on from there. A verdict that the turn began with is
    /// in the checkpoint by now.
    pub fn interrupt<C>(&mut self, report: Report<C>) {
        self.record.checkpoint = Some(report.checkpoint);
        self.record.progress = report.progress;
        self.state.verdict = None;
    }

    /// Whether it ended for no other reason than a budget.
    pub fn ended_by_budget(&self) -> bool {
        self.is_biased()
            && [WalkEnd::Collected, WalkEnd::Budget].iter().any(|end| self.record.state == end.name())
    }
}
