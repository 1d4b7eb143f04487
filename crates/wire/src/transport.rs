//! How a walker speaks to the reactor. Whatever carries the messages, the reactor sees one channel of
//! [`Incoming`]; a walker sees a [`Transport`].

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use calm::Mixture;
use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::{mpsc, oneshot};

use crate::block::{Candidate, CandidateBlock};
use crate::ids::WalkId;
use crate::messages::{Assignment, Progress, Report};

/// A turn and the mixture that holds in it.
#[derive(Clone, Debug)]
pub struct WorkItem {
    /// The turn.
    pub assignment: Assignment,
    /// The mixture, evaluated in place.
    pub mixture: Arc<Mixture>,
}

/// A walker's end of the line.
pub trait Transport: Send {
    /// Delivers what came of the last turn (nothing at first) and waits for the next; `None` when there is
    /// no more work, or nobody to give it. A report is safe only once this has returned `Some`.
    fn exchange(&mut self, report: Option<Report<Candidate>>) -> Option<WorkItem>;

    /// Tells those who watch where a walk stands. May be lost.
    fn progress(&self, walk: WalkId, progress: Progress);

    /// Whether the walker was asked to stop at the next step.
    fn stopping(&self) -> bool;
}

/// What the reactor receives.
#[derive(Debug)]
pub enum Incoming {
    /// A walker is free.
    Idle {
        /// Which walker.
        walker: u32,
        /// What came of its last turn.
        report: Option<Report>,
        /// Where its next turn goes; `None` sends it home.
        reply: oneshot::Sender<Option<WorkItem>>,
    },
    /// Where a walk stands.
    Progress(WalkId, Progress),
    /// A walker is no more, with or without a turn in hand.
    Lost {
        /// Which walker.
        walker: u32,
        /// Whether it died by its own fault, as in a crash, and was not killed from outside: the turn in its hand may do
        /// the same to the next one.
        crashed: bool,
    },
}

/// The transport between threads of one process: values move, only the candidate takes its one form.
#[derive(Debug)]
pub struct InProcess {
    walker: u32,
    to_reactor: mpsc::Sender<Incoming>,
    stopping: Arc<AtomicBool>,
}

impl InProcess {
    /// The end of walker number `walker` of a line into `to_reactor`. Setting `stopping` asks it to stop.
    pub fn new(walker: u32, to_reactor: mpsc::Sender<Incoming>, stopping: Arc<AtomicBool>) -> Self {
        Self { walker, to_reactor, stopping }
    }
}

impl Transport for InProcess {
    fn exchange(&mut self, report: Option<Report<Candidate>>) -> Option<WorkItem> {
        let report =
            report.map(|report| report.map_candidate(|candidate| CandidateBlock::encode(&candidate)));
        let (reply, answer) = oneshot::channel();
        let message = Incoming::Idle { walker: self.walker, report, reply };
        self.to_reactor.blocking_send(message).ok()?;
        answer.blocking_recv().ok().flatten()
    }

    fn progress(&self, walk: WalkId, progress: Progress) {
        // A full channel means that the reactor is busy: whoever watches can do without this one.
        let _ = self.to_reactor.try_send(Incoming::Progress(walk, progress));
    }

    fn stopping(&self) -> bool {
        self.stopping.load(Ordering::Relaxed)
    }
}

/// Also when the walker's thread panics: its turn must not be waited for.
impl Drop for InProcess {
    fn drop(&mut self) {
        let lost = Incoming::Lost { walker: self.walker, crashed: false };
        if let Err(TrySendError::Full(lost)) = self.to_reactor.try_send(lost) {
            let _ = self.to_reactor.blocking_send(lost);
        }
    }
}
