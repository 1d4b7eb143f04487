//! A walker: asks for a turn, works on it, delivers what came of it.

use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use tracing::debug;
use wire::Candidate;
use wire::messages::{Outcome, Progress, Report, WalkEnd};
use wire::transport::{Transport, WorkItem};

use crate::walk::{WalkContext, advance};

/// Time between two signs of life, at least; a longer step makes it longer.
const PROGRESS_INTERVAL: Duration = Duration::from_millis(100);

/// How a walker's work ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// There was no more work for it.
    SentHome,
    /// It was asked to stop; its last turn, if it got one, is somebody else's.
    Stopped,
}

/// Works until there is nothing more to do or the walker is asked to stop.
pub fn run(context: &WalkContext, transport: &mut impl Transport) -> Ended {
    let mut report = None;
    while let Some(work) = transport.exchange(report.take()) {
        if transport.stopping() {
            return Ended::Stopped;
        }
        // A crash is a defect of this program; it ends the walk that met it, not the campaign.
        let begun = Instant::now();
        let turn = catch_unwind(AssertUnwindSafe(|| work_on(context, &work, transport)));
        let made = turn.unwrap_or_else(|_| crashed(&work));
        tell(&work, &made, begun.elapsed());
        report = Some(made);
    }
    Ended::SentHome
}

fn work_on(context: &WalkContext, work: &WorkItem, transport: &impl Transport) -> Report<Candidate> {
    let walk = work.assignment.walk;
    let stopping = || transport.stopping();
    let last = Cell::new(Instant::now());
    let watch = |progress| {
        if last.get().elapsed() >= PROGRESS_INTERVAL {
            last.set(Instant::now());
            transport.progress(walk, progress);
        }
    };
    advance(context, &work.assignment, work.mixture.clone(), stopping, watch)
}

/// Says in the log what came of a turn.
fn tell(work: &WorkItem, made: &Report<Candidate>, time: Duration) {
    let (walk, turn, seconds) = (made.walk.0, made.assignment, time.as_secs_f64());
    let Progress { step, gamma_max, .. } = made.progress;
    let version = work.mixture.version();
    let outcome = match &made.outcome {
        Outcome::Candidate(_) => "candidate",
        Outcome::StepsDone => "turn",
        Outcome::Interrupted => "paused",
        Outcome::Ended(_) => "ended",
    };
    debug!(walk, turn, step, gamma_max, mixture_version = version, seconds, outcome, "made a turn");
}

fn crashed(work: &WorkItem) -> Report<Candidate> {
    let end = WalkEnd::BadStart { reason: "the walker crashed: this is a defect of calmwalk".to_owned() };
    Report {
        walk: work.assignment.walk,
        assignment: work.assignment.number,
        outcome: Outcome::Ended(end),
        checkpoint: work.assignment.checkpoint.clone().unwrap_or_default(),
        progress: Progress::default(),
    }
}
