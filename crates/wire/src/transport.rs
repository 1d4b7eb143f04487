//! Communication between walkers and the reactor. With every transport, the reactor receives from one channel of
//! [`Incoming`], and a walker uses a [`Transport`].

use std::sync::Arc;

use calm::Mixture;
use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;

use crate::block::{Candidate, CandidateBlock};
use crate::ids::WalkId;
use crate::messages::{Assignment, AssignmentReport, WalkProgress};

/// An assignment with its mixture.
#[derive(Clone, Debug)]
pub struct WorkItem {
    /// The assignment.
    pub assignment: Assignment,
    /// The mixture to use, evaluated in place.
    pub mixture: Arc<Mixture>,
}

/// A walker's end of a transport.
pub trait Transport: Send {
    /// Delivers the last report (`None` at first) and waits for the next assignment. Returns `None` when there is no
    /// more work or the orchestrator is gone. The report is committed only if this returns `Some`.
    fn exchange(&mut self, report: Option<AssignmentReport<Candidate>>) -> Option<WorkItem>;

    /// Sends the current state of a walk, for display. May be lost.
    fn progress(&self, walk: WalkId, progress: WalkProgress);

    /// Whether the walker was asked to stop after the current step.
    fn stopping(&self) -> bool;
}

/// What the reactor receives from walkers.
#[derive(Debug)]
pub enum Incoming {
    /// A walker has nothing to do.
    Idle {
        /// Number of the walker.
        walker: u32,
        /// Report on its last assignment.
        report: Option<AssignmentReport>,
        /// Receives the next assignment; `None` shuts the walker down.
        reply: oneshot::Sender<Option<WorkItem>>,
    },
    /// Current state of a walk.
    Progress(WalkId, WalkProgress),
    /// A walker has exited, with or without an assignment.
    Lost {
        /// Number of the walker.
        walker: u32,
        /// Whether it crashed, as opposed to being killed from outside: the assignment may crash the next walker as
        /// well.
        crashed: bool,
    },
}

/// The transport between threads of one process. Values are moved; only the candidate is encoded.
#[derive(Debug)]
pub struct InProcess {
    walker: u32,
    to_reactor: mpsc::Sender<Incoming>,
    stopping: CancellationToken,
}

impl InProcess {
    /// The end of walker number `walker`. Cancelling `stopping` asks the walker to stop.
    pub fn new(walker: u32, to_reactor: mpsc::Sender<Incoming>, stopping: CancellationToken) -> Self {
        Self { walker, to_reactor, stopping }
    }
}

impl Transport for InProcess {
    fn exchange(&mut self, report: Option<AssignmentReport<Candidate>>) -> Option<WorkItem> {
        let report =
            report.map(|report| report.map_candidate(|candidate| CandidateBlock::encode(&candidate)));
        let (reply, answer) = oneshot::channel();
        let message = Incoming::Idle { walker: self.walker, report, reply };
        self.to_reactor.blocking_send(message).ok()?;
        answer.blocking_recv().ok().flatten()
    }

    fn progress(&self, walk: WalkId, progress: WalkProgress) {
        // A full channel means that the reactor is busy. Progress may be lost.
        let _ = self.to_reactor.try_send(Incoming::Progress(walk, progress));
    }

    fn stopping(&self) -> bool {
        self.stopping.is_cancelled()
    }
}

/// Also runs when the walker's thread panics, so that the reactor does not wait for its assignment.
impl Drop for InProcess {
    fn drop(&mut self) {
        let lost = Incoming::Lost { walker: self.walker, crashed: false };
        if let Err(TrySendError::Full(lost)) = self.to_reactor.try_send(lost) {
            let _ = self.to_reactor.blocking_send(lost);
        }
    }
}
