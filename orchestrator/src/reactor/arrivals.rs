//! What arrives for the reactor. Candidates are examined on other threads while the reactor has others committed;
//! everything comes to it in the order in which it arrived.

use std::panic::resume_unwind;
use std::sync::Arc;
use std::thread::available_parallelism;

use calm::Mixture;
use tokio::sync::{Semaphore, mpsc, oneshot, watch};
use tokio::task::{JoinHandle, JoinSet, spawn_blocking};
use wire::WalkId;
use wire::messages::{Progress, Report};
use wire::transport::{Incoming, Work};

use crate::selector::{ExaminedReport, Examiner};

/// Messages on their way, at most.
const AHEAD: usize = 64;

/// The reactor's end of the line.
pub(super) struct Arrivals {
    messages: mpsc::Receiver<Arrival>,
    newest: watch::Sender<Arc<Mixture>>,
    /// Whoever drops the arrivals ends the task that brings them.
    _task: JoinSet<()>,
}

/// As [`Incoming`], its report about to be examined.
pub(super) enum Arrival {
    Free { walker: u32, report: Option<Examining>, reply: oneshot::Sender<Option<Work>> },
    Progress(WalkId, Progress),
    Gone { walker: u32, fault: Option<String> },
}

/// An examination under way.
pub(super) struct Examining(JoinHandle<ExaminedReport>);

impl Arrivals {
    /// Begins to take what comes in. `mixture` is the one in force.
    pub fn new(incoming: mpsc::Receiver<Incoming>, examiner: Examiner, mixture: &Arc<Mixture>) -> Self {
        let (to_reactor, messages) = mpsc::channel(AHEAD);
        let (newest, mixture) = watch::channel(Arc::clone(mixture));
        let mut task = JoinSet::new();
        task.spawn(bring(incoming, examiner, mixture, to_reactor));
        Self { messages, newest, _task: task }
    }

    /// Waits for a message and takes all that have arrived by then, up to `most`; none when nothing will come any more.
    pub async fn take(&mut self, most: usize) -> Vec<Arrival> {
        let mut messages = Vec::new();
        self.messages.recv_many(&mut messages, most).await;
        messages
    }

    /// Says which mixture is in force, for those that are examined from now on.
    pub fn in_force(&self, mixture: &Arc<Mixture>) {
        self.newest.send_if_modified(|newest| {
            let moved = !Arc::ptr_eq(newest, mixture);
            if moved {
                *newest = Arc::clone(mixture);
            }
            moved
        });
    }
}

impl Examining {
    pub async fn done(self) -> ExaminedReport {
        self.0.await.unwrap_or_else(|error| resume_unwind(error.into_panic()))
    }
}

/// Begins an examination for every report, as many side by side as there are cores.
async fn bring(
    mut incoming: mpsc::Receiver<Incoming>,
    examiner: Examiner,
    mixture: watch::Receiver<Arc<Mixture>>,
    to_reactor: mpsc::Sender<Arrival>,
) {
    let cores = Arc::new(Semaphore::new(available_parallelism().map_or(1, |cores| cores.get())));
    let examine = async |report: Report| {
        let core = Arc::clone(&cores).acquire_owned().await.expect("the semaphore is never closed");
        let (examiner, mixture) = (examiner.clone(), Arc::clone(&mixture.borrow()));
        Examining(spawn_blocking(move || {
            let _core = core;
            examiner.examine(report, &mixture)
        }))
    };
    while let Some(message) = incoming.recv().await {
        let arrival = match message {
            Incoming::Progress(walk, progress) => Arrival::Progress(walk, progress),
            Incoming::Gone { walker, fault } => Arrival::Gone { walker, fault },
            Incoming::Free { walker, report, reply } => {
                let report = match report {
                    Some(report) => Some(examine(report).await),
                    None => None,
                };
                Arrival::Free { walker, report, reply }
            }
        };
        if to_reactor.send(arrival).await.is_err() {
            return;
        }
    }
}
