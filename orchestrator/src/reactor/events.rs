//! What arrives for the reactor. Candidates are examined on other threads while the reactor has others committed;
//! everything comes to it in the order in which it arrived.

use std::panic::resume_unwind;
use std::pin::Pin;
use std::sync::Arc;
use std::thread::available_parallelism;

use calm::Mixture;
use futures_util::stream::{self, Stream, StreamExt};
use tokio::sync::{Semaphore, mpsc, oneshot, watch};
use tokio::task::{JoinHandle, JoinSet, spawn_blocking};
use wire::WalkId;
use wire::messages::Progress;
use wire::transport::{Incoming, WorkItem};

use crate::selector::{RegradedReport, Regrader};

/// Messages on their way, at most.
const MAX_IN_FLIGHT: usize = 64;
/// Messages that are taken together, at most.
const MAX_BATCH: usize = 64;

/// The reactor's end of the line.
pub(super) struct EventStream {
    batches: Pin<Box<dyn Stream<Item = Vec<ReactorEvent>> + Send>>,
    newest: watch::Sender<Arc<Mixture>>,
    /// Whoever drops the events ends the task that brings them.
    _task: JoinSet<()>,
}

/// As [`Incoming`], its report examined, or about to be.
pub(super) enum ReactorEvent<R = RegradedReport> {
    Idle { walker: u32, report: Option<R>, reply: oneshot::Sender<Option<WorkItem>> },
    Progress(WalkId, Progress),
    Lost { walker: u32, crashed: bool },
}

impl EventStream {
    /// Begins to take what comes in. `mixture` is the one in force.
    pub fn new(incoming: mpsc::Receiver<Incoming>, regrader: Regrader, mixture: &Arc<Mixture>) -> Self {
        let (to_reactor, mut messages) = mpsc::channel(MAX_IN_FLIGHT);
        let (newest, mixture) = watch::channel(Arc::clone(mixture));
        let mut task = JoinSet::new();
        task.spawn(forward(incoming, regrader, mixture, to_reactor));
        let messages = stream::poll_fn(move |context| messages.poll_recv(context));
        let batches = messages.map(ReactorEvent::regraded).buffered(MAX_IN_FLIGHT).ready_chunks(MAX_BATCH);
        Self { batches: Box::pin(batches), newest, _task: task }
    }

    /// Waits until what came first has been examined, and takes all that is ready behind it; nothing when nothing will
    /// come any more. May be given up while it waits: nothing is lost by that.
    pub async fn take(&mut self) -> Option<Vec<ReactorEvent>> {
        self.batches.next().await
    }

    /// Says which mixture is in force, for those that are examined from now on.
    pub fn set_mixture(&self, mixture: &Arc<Mixture>) {
        self.newest.send_if_modified(|newest| {
            let moved = !Arc::ptr_eq(newest, mixture);
            if moved {
                *newest = Arc::clone(mixture);
            }
            moved
        });
    }
}

impl ReactorEvent<JoinHandle<RegradedReport>> {
    async fn regraded(self) -> ReactorEvent {
        match self {
            Self::Idle { walker, report, reply } => {
                let report = match report {
                    Some(report) => {
                        Some(report.await.unwrap_or_else(|error| resume_unwind(error.into_panic())))
                    }
                    None => None,
                };
                ReactorEvent::Idle { walker, report, reply }
            }
            Self::Progress(walk, progress) => ReactorEvent::Progress(walk, progress),
            Self::Lost { walker, crashed } => ReactorEvent::Lost { walker, crashed },
        }
    }
}

/// Begins an examination for every report, as many side by side as there are cores.
async fn forward(
    mut incoming: mpsc::Receiver<Incoming>,
    regrader: Regrader,
    mixture: watch::Receiver<Arc<Mixture>>,
    to_reactor: mpsc::Sender<ReactorEvent<JoinHandle<RegradedReport>>>,
) {
    let cores = Arc::new(Semaphore::new(available_parallelism().map_or(1, |cores| cores.get())));
    while let Some(message) = incoming.recv().await {
        let event = match message {
            Incoming::Progress(walk, progress) => ReactorEvent::Progress(walk, progress),
            Incoming::Lost { walker, crashed } => ReactorEvent::Lost { walker, crashed },
            Incoming::Idle { walker, report, reply } => {
                let report = match report {
                    Some(report) => {
                        let core = Arc::clone(&cores).acquire_owned().await;
                        let (regrader, mixture) = (regrader.clone(), Arc::clone(&mixture.borrow()));
                        Some(spawn_blocking(move || {
                            let _core = core.expect("the semaphore is never closed");
                            regrader.regrade(report, &mixture)
                        }))
                    }
                    None => None,
                };
                ReactorEvent::Idle { walker, report, reply }
            }
        };
        if to_reactor.send(event).await.is_err() {
            return;
        }
    }
}
