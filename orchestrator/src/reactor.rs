//! The shell round the selector: takes reports from the channel, has every commit written, then answers.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use store::records::Commit;
use store::{Store, StoreError};
use tokio::sync::{mpsc, oneshot};
use wire::WalkId;
use wire::messages::Progress;
use wire::transport::{Incoming, Work};

use crate::selector::{Next, Selector, SelectorError};

/// How often a full label queue is looked at again.
const QUEUE_LOOK: Duration = Duration::from_millis(200);

/// Why a campaign cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum ReactorError {
    /// The selector gave up.
    #[error(transparent)]
    Selector(#[from] SelectorError),
    /// The store gave up.
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// What those who watch are told.
#[derive(Debug)]
pub enum Notice<'a> {
    /// Where a walk stands.
    Progress(WalkId, Progress),
    /// What was just committed.
    Committed(&'a Commit),
    /// Walkers wait because this many label jobs wait.
    QueueFull(u64),
}

/// How the reactor's work ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// Every walk is over.
    Done,
    /// It was asked to stop; the campaign can go on later.
    Stopped,
}

/// What the reactor works with.
pub struct Reactor {
    /// The core.
    pub selector: Selector,
    /// The campaign's database.
    pub store: Store,
    /// Reports of walkers.
    pub incoming: mpsc::Receiver<Incoming>,
    /// Set from outside, by Ctrl-C say: walkers are sent home with their walks where they stand.
    pub stopping: Arc<AtomicBool>,
    /// Walkers wait while more label jobs than this are unfinished.
    pub queue_limit: u64,
}

impl Reactor {
    /// Runs until every walker has been sent home: all walks over, or stopped.
    pub async fn run(mut self, mut watch: impl FnMut(Notice<'_>)) -> Result<Ended, ReactorError> {
        let mut waiting = VecDeque::new();
        let mut ended = Ended::Done;
        loop {
            let message = tokio::select! {
                message = self.incoming.recv() => message,
                () = tokio::time::sleep(QUEUE_LOOK), if !waiting.is_empty() => {
                    ended = self.answer(&mut waiting, &mut watch).await?.unwrap_or(ended);
                    continue;
                }
            };
            match message {
                // Every walker has gone home.
                None => return Ok(ended),
                Some(Incoming::Progress(walk, progress)) => watch(Notice::Progress(walk, progress)),
                Some(Incoming::Free { report, reply, .. }) => {
                    let commit = report.map(|report| self.selector.report(report)).transpose()?.flatten();
                    if let Some(commit) = commit {
                        self.store.commit(&commit).await?;
                        watch(Notice::Committed(&commit));
                    }
                    waiting.push_back(reply);
                    ended = self.answer(&mut waiting, &mut watch).await?.unwrap_or(ended);
                }
            }
        }
    }

    /// Gives turns to waiting walkers as far as there are any; says how it ended once it sends walkers home.
    async fn answer(
        &mut self,
        waiting: &mut VecDeque<oneshot::Sender<Option<Work>>>,
        watch: &mut impl FnMut(Notice<'_>),
    ) -> Result<Option<Ended>, ReactorError> {
        if self.stopping.load(Ordering::Relaxed) {
            send_home(waiting);
            return Ok(Some(Ended::Stopped));
        }
        let unfinished = self.store.unfinished_jobs().await?;
        if unfinished > self.queue_limit {
            watch(Notice::QueueFull(unfinished));
            return Ok(None);
        }
        while let Some(reply) = waiting.pop_front() {
            match self.selector.next() {
                Next::Turn(assignment) => {
                    let walk = assignment.walk;
                    let work = Work { assignment: *assignment, mixture: Arc::clone(self.selector.mixture()) };
                    if reply.send(Some(work)).is_err() {
                        self.selector.lost(walk);
                    }
                }
                Next::Wait => {
                    waiting.push_front(reply);
                    return Ok(None);
                }
                Next::Done => {
                    waiting.push_front(reply);
                    send_home(waiting);
                    return Ok(Some(Ended::Done));
                }
            }
        }
        Ok(None)
    }
}

fn send_home(waiting: &mut VecDeque<oneshot::Sender<Option<Work>>>) {
    for reply in waiting.drain(..) {
        // A walker that is gone already needs no answer.
        let _ = reply.send(None);
    }
}
