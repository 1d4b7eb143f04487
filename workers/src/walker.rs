//! The walker loop: asks for an assignment, works on it and reports the result.

use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use tracing::debug;
use wire::Candidate;
use wire::messages::{AssignmentReport, Outcome, WalkEnd, WalkProgress};
use wire::transport::{Transport, WorkItem};

use crate::walk::{PotentialUnavailable, WalkContext, advance};

/// Minimum time between two progress reports; longer steps make it longer.
const PROGRESS_INTERVAL: Duration = Duration::from_millis(100);

/// Why a walker ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum WalkerExit {
    /// There was no more work.
    Dismissed,
    /// It was asked to stop. Another walker gets its last assignment, if it had one.
    Stopped,
    /// The program that evaluates the potential does not answer any more. Its last assignment is not reported.
    PotentialUnavailable(String),
}

/// Works on assignments until there are no more or the walker is asked to stop.
pub fn run(context: &WalkContext, transport: &mut impl Transport) -> WalkerExit {
    let mut report = None;
    while let Some(work) = transport.exchange(report.take()) {
        if transport.stopping() {
            return WalkerExit::Stopped;
        }
        // A panic is a defect of this program. It ends the walk that caused it, not the campaign.
        let started = Instant::now();
        let result = catch_unwind(AssertUnwindSafe(|| run_assignment(context, &work, transport)));
        let made = match result {
            Ok(Ok(made)) => made,
            Ok(Err(_)) if transport.stopping() => return WalkerExit::Stopped,
            Ok(Err(PotentialUnavailable(reason))) => return WalkerExit::PotentialUnavailable(reason),
            Err(_) => crash_report(&work),
        };
        log_outcome(&work, &made, started.elapsed());
        report = Some(made);
    }
    WalkerExit::Dismissed
}

fn run_assignment(
    context: &WalkContext,
    work: &WorkItem,
    transport: &impl Transport,
) -> Result<AssignmentReport<Candidate>, PotentialUnavailable> {
    let walk = work.assignment.walk;
    let stopping = || transport.stopping();
    let last = Cell::new(Instant::now());
    let on_progress = |progress| {
        if last.get().elapsed() >= PROGRESS_INTERVAL {
            last.set(Instant::now());
            transport.progress(walk, progress);
        }
    };
    advance(context, &work.assignment, work.mixture.clone(), stopping, on_progress)
}

/// Logs the outcome of an assignment.
fn log_outcome(work: &WorkItem, made: &AssignmentReport<Candidate>, time: Duration) {
    let (walk, assignment, seconds) = (made.walk.0, made.assignment, time.as_secs_f64());
    let WalkProgress { step, gamma_max, .. } = made.progress;
    let version = work.mixture.version();
    let outcome = match &made.outcome {
        Outcome::Candidate(_) => "candidate",
        Outcome::StepsDone => "steps_done",
        Outcome::Interrupted => "interrupted",
        Outcome::Ended(_) => "ended",
    };
    debug!(
        walk,
        assignment,
        step,
        gamma_max,
        mixture_version = version,
        seconds,
        outcome,
        "finished an assignment"
    );
}

fn crash_report(work: &WorkItem) -> AssignmentReport<Candidate> {
    let end = WalkEnd::InvalidStart { reason: "the walker crashed: this is a defect of calmwalk".to_owned() };
    AssignmentReport {
        walk: work.assignment.walk,
        assignment: work.assignment.number,
        start: None,
        outcome: Outcome::Ended(end),
        checkpoint: work.assignment.checkpoint.clone().unwrap_or_default(),
        progress: WalkProgress::default(),
        trace: Vec::new(),
    }
}
