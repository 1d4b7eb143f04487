//! The shell round the selector: takes reports from the channel, has every commit written, then answers.
//!
//! To have a transaction on the disk takes longer than most decisions. So the reactor takes all that has arrived
//! meanwhile, has it decided one after the other, and commits it as one group; everybody is answered after that.

mod arrivals;
pub mod group;

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

use self::arrivals::{Arrival, Arrivals};
use crate::selector::{Next, Selector, SelectorError};

/// How often a full label queue is looked at again.
const QUEUE_LOOK: Duration = Duration::from_millis(200);
/// A turn may cost so many walkers, which crashed with it in hand; then its walk is over.
const MOST_WALKERS: u32 = 3;
/// Messages of a group, at most: those who came first should not wait for long.
const GROUP: usize = 64;

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

/// The reactor at work: what it works with, and the walkers as far as it must know of them.
struct Shell {
    selector: Selector,
    store: Store,
    stopping: Arc<AtomicBool>,
    queue_limit: u64,
    /// Walkers that wait for a turn, in the order in which they came.
    waiting: VecDeque<(u32, oneshot::Sender<Option<Work>>)>,
    /// The walk that each of the others has in hand.
    at_work: HashMap<u32, WalkId>,
    /// Walkers that crashed with the present turn of a walk.
    costs: HashMap<WalkId, u32>,
}

impl Reactor {
    /// Runs until every walker has been sent home: all walks over, or stopped.
    pub async fn run(self, mut watch: impl FnMut(Notice<'_>)) -> Result<Ended, ReactorError> {
        let Self { selector, store, incoming, stopping, queue_limit } = self;
        let mut arrivals = Arrivals::new(incoming, selector.examiner().clone(), selector.mixture());
        let (waiting, at_work, costs) = (VecDeque::new(), HashMap::new(), HashMap::new());
        let mut shell = Shell { selector, store, stopping, queue_limit, waiting, at_work, costs };
        // An interval, not a time since the last message: walkers at work may report progress without a pause.
        let mut look = tokio::time::interval(QUEUE_LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            let group = tokio::select! {
                group = arrivals.take(GROUP) => group,
                _ = look.tick(), if !shell.waiting.is_empty() => {
                    shell.answer(&mut watch).await?;
                    continue;
                }
            };
            if group.is_empty() {
                // Every walker has gone home.
                return Ok(if shell.selector.is_done() { Ended::Done } else { Ended::Stopped });
            }
            let answer = group.iter().any(|arrival| !matches!(arrival, Arrival::Progress(..)));
            let commit = shell.decide(group, &mut watch).await?;
            arrivals.in_force(shell.selector.mixture());
            if let Some(commit) = commit {
                shell.store.commit(&commit).await?;
                watch(Notice::Committed(&commit));
            }
            if answer {
                shell.answer(&mut watch).await?;
            }
        }
    }
}

impl Shell {
    /// Takes a group in, in the order in which it arrived. Returns what is to be committed before anybody is answered.
    async fn decide(
        &mut self,
        group: Vec<Arrival>,
        watch: &mut impl FnMut(Notice<'_>),
    ) -> Result<Option<Commit>, ReactorError> {
        let mut whole = None;
        for arrival in group {
            match arrival {
                Arrival::Progress(walk, progress) => watch(Notice::Progress(walk, progress)),
                Arrival::Free { walker, report, reply } => {
                    self.at_work.remove(&walker);
                    self.waiting.push_back((walker, reply));
                    let Some(report) = report else { continue };
                    let report = report.done().await;
                    self.costs.remove(&report.walk);
                    if let Some(commit) = self.selector.examined(report)? {
                        group::append(whole.get_or_insert_default(), commit);
                    }
                }
                Arrival::Gone { walker, fault } => {
                    let Some(walk) = self.at_work.remove(&walker) else { continue };
                    if let Some(commit) = self.lost(walk, fault)? {
                        group::append(whole.get_or_insert_default(), commit);
                    }
                }
            }
        }
        Ok(whole)
    }

    /// A walker was lost with a turn in hand: another gets it, unless it is the turn that kills them.
    fn lost(&mut self, walk: WalkId, fault: Option<String>) -> Result<Option<Commit>, ReactorError> {
        if fault.is_some() {
            let cost = self.costs.entry(walk).or_default();
            *cost += 1;
            if *cost == MOST_WALKERS {
                // Not how: the last words of a process are not the same twice.
                let reason = format!("{MOST_WALKERS} walkers crashed in this turn");
                return Ok(self.selector.give_up(walk, reason)?);
            }
        }
        self.selector.lost(walk);
        Ok(None)
    }

    /// Gives turns to waiting walkers as far as there are any, or sends them home.
    async fn answer(&mut self, watch: &mut impl FnMut(Notice<'_>)) -> Result<(), ReactorError> {
        if self.stopping.load(Ordering::Relaxed) {
            self.send_home();
            return Ok(());
        }
        let unfinished = self.store.unfinished_jobs().await?;
        if unfinished > self.queue_limit {
            watch(Notice::QueueFull(unfinished));
            return Ok(());
        }
        while let Some((walker, reply)) = self.waiting.pop_front() {
            match self.selector.next_turn() {
                Next::Turn(assignment) => {
                    let walk = assignment.walk;
                    let work = Work { assignment: *assignment, mixture: Arc::clone(self.selector.mixture()) };
                    if reply.send(Some(work)).is_ok() {
                        self.at_work.insert(walker, walk);
                    } else {
                        self.selector.lost(walk);
                    }
                }
                Next::Wait => {
                    self.waiting.push_front((walker, reply));
                    return Ok(());
                }
                Next::Done => {
                    self.waiting.push_front((walker, reply));
                    self.send_home();
                }
            }
        }
        Ok(())
    }

    fn send_home(&mut self) {
        for (_, reply) in self.waiting.drain(..) {
            // A walker that is gone already needs no answer.
            let _ = reply.send(None);
        }
    }
}
