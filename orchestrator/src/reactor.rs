//! The shell round the selector: takes reports from the channel, has every commit written, then answers.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use store::records::Commit;
use store::{Store, StoreError};
use tokio::sync::{mpsc, oneshot};
use tokio::time::MissedTickBehavior;
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
    /// Walks are left, but it was asked to stop, or every walker is gone; the campaign can go on later.
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

/// The walkers, as far as the reactor must know of them.
#[derive(Default)]
struct Walkers {
    /// Those that wait for a turn, in the order in which they came.
    waiting: VecDeque<(u32, oneshot::Sender<Option<Work>>)>,
    /// The walk that each of the others has in hand.
    at_work: HashMap<u32, WalkId>,
}

impl Reactor {
    /// Runs until every walker has been sent home: all walks over, or stopped.
    pub async fn run(mut self, mut watch: impl FnMut(Notice<'_>)) -> Result<Ended, ReactorError> {
        let mut walkers = Walkers::default();
        // An interval, not a time since the last message: walkers at work may report progress without a pause.
        let mut look = tokio::time::interval(QUEUE_LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            let message = tokio::select! {
                message = self.incoming.recv() => message,
                _ = look.tick(), if !walkers.waiting.is_empty() => {
                    self.answer(&mut walkers, &mut watch).await?;
                    continue;
                }
            };
            match message {
                // Every walker has gone home.
                None => return Ok(if self.selector.is_done() { Ended::Done } else { Ended::Stopped }),
                Some(Incoming::Progress(walk, progress)) => watch(Notice::Progress(walk, progress)),
                Some(Incoming::Free { walker, report, reply }) => {
                    walkers.at_work.remove(&walker);
                    let commit = report.map(|report| self.selector.report(report)).transpose()?.flatten();
                    if let Some(commit) = commit {
                        self.store.commit(&commit).await?;
                        watch(Notice::Committed(&commit));
                    }
                    walkers.waiting.push_back((walker, reply));
                    self.answer(&mut walkers, &mut watch).await?;
                }
                Some(Incoming::Gone { walker }) => {
                    if let Some(walk) = walkers.at_work.remove(&walker) {
                        self.selector.lost(walk);
                        self.answer(&mut walkers, &mut watch).await?;
                    }
                }
            }
        }
    }

    /// Gives turns to waiting walkers as far as there are any, or sends them home.
    async fn answer(
        &mut self,
        walkers: &mut Walkers,
        watch: &mut impl FnMut(Notice<'_>),
    ) -> Result<(), ReactorError> {
        if self.stopping.load(Ordering::Relaxed) {
            walkers.send_home();
            return Ok(());
        }
        let unfinished = self.store.unfinished_jobs().await?;
        if unfinished > self.queue_limit {
            watch(Notice::QueueFull(unfinished));
            return Ok(());
        }
        while let Some((walker, reply)) = walkers.waiting.pop_front() {
            match self.selector.next_turn() {
                Next::Turn(assignment) => {
                    let walk = assignment.walk;
                    let work = Work { assignment: *assignment, mixture: Arc::clone(self.selector.mixture()) };
                    if reply.send(Some(work)).is_ok() {
                        walkers.at_work.insert(walker, walk);
                    } else {
                        self.selector.lost(walk);
                    }
                }
                Next::Wait => {
                    walkers.waiting.push_front((walker, reply));
                    return Ok(());
                }
                Next::Done => {
                    walkers.waiting.push_front((walker, reply));
                    walkers.send_home();
                }
            }
        }
        Ok(())
    }
}

impl Walkers {
    fn send_home(&mut self) {
        for (_, reply) in self.waiting.drain(..) {
            // A walker that is gone already needs no answer.
            let _ = reply.send(None);
        }
    }
}
