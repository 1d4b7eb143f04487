//! A scripted walk without dynamics. Like a real walk, it is a function of assignment and mixture: the same assignment
//! gives the same report on any walker, any number of times, with or without interruptions.

use calm::Mixture;
use serde::{Deserialize, Serialize};
use wire::Origin;
use wire::messages::{Assignment, AssignmentReport, Outcome, WalkEnd, WalkProgress};

use super::{DIMENSION, SHORTEST, at, block, gamma_max, structure};

/// A distance below the limit of the walks, Å.
const CLOSE: f64 = 0.7 * SHORTEST;

/// The events of a walk, one per step.
pub type Script = Vec<Event>;

#[derive(Clone, Debug)]
pub enum Event {
    Nothing,
    /// A structure with this number and features of its second atom; if `close`, its atoms are too close.
    Structure {
        number: u64,
        z: [f64; DIMENSION],
        close: bool,
    },
    /// A rollback to the checkpoint of two steps before.
    Return,
    BlowUp,
    /// A structure whose features are not finite.
    Ungradable,
}

/// The checkpoint of a scripted walk.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
struct State {
    /// Number of past events.
    events: usize,
    step: u64,
    segment: u32,
}

/// Works on the assignment; interrupted after this number of steps if it takes longer.
pub fn advance(
    script: &Script,
    assignment: &Assignment,
    mixture: &Mixture,
    pause_after: Option<u64>,
) -> AssignmentReport {
    let mut state = assignment
        .checkpoint
        .as_ref()
        .map_or_else(State::default, |bytes| serde_json::from_slice(bytes).unwrap());
    let mut steps = 0;
    let outcome = loop {
        let Some(event) = script.get(state.events) else { break Outcome::Ended(WalkEnd::Completed) };
        if state.step >= assignment.last_step {
            break Outcome::StepsDone;
        }
        if pause_after == Some(steps) {
            break Outcome::Interrupted;
        }
        steps += 1;
        state.step += 1;
        state.events += 1;
        if let Some(outcome) = meet(event, assignment, mixture, &mut state) {
            break outcome;
        }
    };
    let checkpoint = serde_json::to_vec(&state).unwrap();
    AssignmentReport {
        walk: assignment.walk,
        assignment: assignment.number,
        outcome,
        checkpoint,
        progress: progress(&state),
        start: None,
        trace: Vec::new(),
        frames: Vec::new(),
    }
}

fn meet(event: &Event, assignment: &Assignment, mixture: &Mixture, state: &mut State) -> Option<Outcome> {
    if assignment.origin == Origin::Control {
        // Without bias, a control walk meets no events of the script; its frames are those of another walk.
        let number = 2_000_000 + 1000 * u64::from(assignment.walk.0) + state.step;
        // Some of them cannot be graded, and in some the atoms are too close.
        let z = if state.step % 7 == 3 { [f64::NAN; DIMENSION] } else { [0.5; DIMENSION] };
        let distance = if state.step % 5 == 2 { CLOSE } else { SHORTEST };
        let frame = || block(assignment, mixture, &progress(state), structure(number, distance), z);
        return assignment.frame_steps.contains(&state.step).then(|| Outcome::Candidate(frame()));
    }
    match *event {
        Event::Nothing => None,
        Event::Structure { number, z, close } => {
            let distance = if close { CLOSE } else { SHORTEST };
            let candidate = || block(assignment, mixture, &progress(state), structure(number, distance), z);
            (gamma_max(mixture, z) > 1.5).then(|| Outcome::Candidate(candidate()))
        }
        Event::Return => {
            state.segment += 1;
            state.step = state.step.saturating_sub(2);
            None
        }
        Event::Ungradable => {
            let structure = structure(1_000_000 + state.step, SHORTEST);
            let block = block(assignment, mixture, &progress(state), structure, [f64::NAN; DIMENSION]);
            Some(Outcome::Candidate(block))
        }
        Event::BlowUp => {
            Some(Outcome::Ended(WalkEnd::Diverged { reason: format!("at step {}", state.step) }))
        }
    }
}

fn progress(state: &State) -> WalkProgress {
    WalkProgress { segment: state.segment, rollbacks: state.segment, ..at(state.step) }
}
