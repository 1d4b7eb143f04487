//! The events of the reactor. Candidates are regraded on other threads while the reactor waits for commits; events
//! arrive in the order of their messages.

use std::panic::resume_unwind;
use std::pin::Pin;
use std::sync::Arc;
use std::thread::available_parallelism;

use calm::Mixture;
use futures_util::stream::{self, Stream, StreamExt};
use tokio::sync::{Semaphore, mpsc, oneshot, watch};
use tokio::task::{JoinHandle, JoinSet, spawn_blocking};
use wire::WalkId;
use wire::messages::WalkProgress;
use wire::transport::{Incoming, WorkItem};

use crate::selector::{RegradedReport, Regrader};

/// Maximum number of messages being processed.
const MAX_IN_FLIGHT: usize = 64;
/// Maximum number of events in a batch.
const MAX_BATCH: usize = 64;

/// The reactor's end of the stream of events.
pub(super) struct EventStream {
    batches: Pin<Box<dyn Stream<Item = Vec<ReactorEvent>> + Send>>,
    newest: watch::Sender<Arc<Mixture>>,
    /// Dropping the stream ends the task that feeds it.
    _task: JoinSet<()>,
}

/// Like [`Incoming`], with a report that is regraded, or being regraded.
pub(super) enum ReactorEvent<R = RegradedReport> {
    Idle { walker: u32, report: Option<R>, reply: oneshot::Sender<Option<WorkItem>> },
    Progress(WalkId, WalkProgress),
    Lost { walker: u32, crashed: bool },
}

impl EventStream {
    /// Starts receiving messages. `mixture` is the current mixture.
    pub fn new(incoming: mpsc::Receiver<Incoming>, regrader: Regrader, mixture: &Arc<Mixture>) -> Self {
        let (to_reactor, mut messages) = mpsc::channel(MAX_IN_FLIGHT);
        let (newest, mixture) = watch::channel(Arc::clone(mixture));
        let mut task = JoinSet::new();
        task.spawn(forward(incoming, regrader, mixture, to_reactor));
        let messages = stream::poll_fn(move |context| messages.poll_recv(context));
        let batches = messages.map(ReactorEvent::regraded).buffered(MAX_IN_FLIGHT).ready_chunks(MAX_BATCH);
        Self { batches: Box::pin(batches), newest, _task: task }
    }

    /// Waits until the first event is ready, and returns it with all ready events that follow; `None` at the end of the
    /// stream. Cancel safe.
    pub async fn take(&mut self) -> Option<Vec<ReactorEvent>> {
        self.batches.next().await
    }

    /// Sets the current mixture, which is used for all later messages.
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

/// Starts regrading every report, on as many threads as there are cores.
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
