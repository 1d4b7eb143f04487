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
use wire::transport::{Incoming, Work};

use crate::selector::{ExaminedReport, Examiner};

/// Messages on their way, at most.
const AHEAD: usize = 64;
/// Messages that are taken together, at most.
const GROUP: usize = 64;

/// The reactor's end of the line.
pub(super) struct Arrivals {
    groups: Pin<Box<dyn Stream<Item = Vec<Arrival>> + Send>>,
    newest: watch::Sender<Arc<Mixture>>,
    /// Whoever drops the arrivals ends the task that brings them.
    _task: JoinSet<()>,
}

/// As [`Incoming`], its report examined, or about to be.
pub(super) enum Arrival<R = ExaminedReport> {
    Free { walker: u32, report: Option<R>, reply: oneshot::Sender<Option<Work>> },
    Progress(WalkId, Progress),
    Gone { walker: u32, fault: bool },
}

impl Arrivals {
    /// Begins to take what comes in. `mixture` is the one in force.
    pub fn new(incoming: mpsc::Receiver<Incoming>, examiner: Examiner, mixture: &Arc<Mixture>) -> Self {
        let (to_reactor, mut messages) = mpsc::channel(AHEAD);
        let (newest, mixture) = watch::channel(Arc::clone(mixture));
        let mut task = JoinSet::new();
        task.spawn(bring(incoming, examiner, mixture, to_reactor));
        let messages = stream::poll_fn(move |context| messages.poll_recv(context));
        let groups = messages.map(Arrival::examined).buffered(AHEAD).ready_chunks(GROUP);
        Self { groups: Box::pin(groups), newest, _task: task }
    }

    /// Waits until what came first has been examined, and takes all that is ready behind it; nothing when nothing will
    /// come any more. May be given up while it waits: nothing is lost by that.
    pub async fn take(&mut self) -> Option<Vec<Arrival>> {
        self.groups.next().await
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

impl Arrival<JoinHandle<ExaminedReport>> {
    async fn examined(self) -> Arrival {
        match self {
            Self::Free { walker, report, reply } => {
                let report = match report {
                    Some(report) => {
                        Some(report.await.unwrap_or_else(|error| resume_unwind(error.into_panic())))
                    }
                    None => None,
                };
                Arrival::Free { walker, report, reply }
            }
            Self::Progress(walk, progress) => Arrival::Progress(walk, progress),
            Self::Gone { walker, fault } => Arrival::Gone { walker, fault },
        }
    }
}

/// Begins an examination for every report, as many side by side as there are cores.
async fn bring(
    mut incoming: mpsc::Receiver<Incoming>,
    examiner: Examiner,
    mixture: watch::Receiver<Arc<Mixture>>,
    to_reactor: mpsc::Sender<Arrival<JoinHandle<ExaminedReport>>>,
) {
    let cores = Arc::new(Semaphore::new(available_parallelism().map_or(1, |cores| cores.get())));
    while let Some(message) = incoming.recv().await {
        let arrival = match message {
            Incoming::Progress(walk, progress) => Arrival::Progress(walk, progress),
            Incoming::Gone { walker, fault } => Arrival::Gone { walker, fault },
            Incoming::Free { walker, report, reply } => {
                let report = match report {
                    Some(report) => {
                        let core = Arc::clone(&cores).acquire_owned().await;
                        let (examiner, mixture) = (examiner.clone(), Arc::clone(&mixture.borrow()));
                        Some(spawn_blocking(move || {
                            let _core = core.expect("the semaphore is never closed");
                            examiner.examine(report, &mixture)
                        }))
                    }
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
