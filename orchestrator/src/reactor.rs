//! The shell round the selector: takes reports from the channel, has every commit written, then answers.
//!
//! To have a transaction on the disk takes longer than most decisions. So what arrives during a commit is decided
//! meanwhile, one after the other, and committed as one group when that commit is done. Everybody is answered when
//! what was decided about them, and all before it, is on the disk.

mod arrivals;
pub mod group;
mod log;

use std::collections::{HashMap, VecDeque};
use std::panic::resume_unwind;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use store::records::{Commit, Fate};
use store::{Store, StoreError};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;
use tracing::{debug, warn};
use wire::WalkId;
use wire::messages::Progress;
use wire::transport::{Incoming, Work};

use self::arrivals::{Arrival, Arrivals};
use crate::selector::{Next, Selector, SelectorError};

/// How often a full label queue and paused walks are looked at again, and for how long what was found is good.
const LOOK: Duration = Duration::from_millis(200);
/// A turn may cost so many walkers, which crashed with it in hand; then its walk is over.
const MOST_WALKERS: u32 = 3;

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
    /// Walkers wait while more label jobs than this are unfinished, unless the selector raises its threshold first.
    pub queue_limit: u64,
}

/// The reactor at work: what it works with, and the walkers as far as it must know of them.
struct Shell {
    selector: Selector,
    store: Store,
    stopping: Arc<AtomicBool>,
    queue_limit: u64,
    /// What is decided and not yet on its way to the disk.
    decided: Option<Commit>,
    /// Walkers that wait for a turn, in the order in which they came.
    waiting: VecDeque<(u32, Reply)>,
    /// Those whose answer is known and waits for the commit before it.
    promised: Vec<Promise>,
    /// The walk that each of the others has in hand.
    at_work: HashMap<u32, WalkId>,
    /// Walkers that crashed with the present turn of a walk.
    costs: HashMap<WalkId, u32>,
    /// Label jobs that are unfinished at most, and when they were counted.
    unfinished: Option<(u64, Instant)>,
    /// When it was last looked which walks people have paused.
    paused_at: Option<Instant>,
}

type Reply = oneshot::Sender<Option<Work>>;

/// The answer to a walker.
struct Promise {
    walker: u32,
    reply: Reply,
    work: Option<Work>,
}

impl Reactor {
    /// Runs until no walker has a turn in hand and there is none to be given out, because all walks are over or because
    /// it is stopped; or until no walker can come any more.
    pub async fn run(self, mut watch: impl FnMut(Notice<'_>)) -> Result<Ended, ReactorError> {
        let mut arrivals =
            Arrivals::new(self.incoming, self.selector.examiner().clone(), self.selector.mixture());
        let mut shell = Shell::new(self.selector, self.store, self.stopping, self.queue_limit);
        // An interval, not a time since the last message: walkers at work may report progress without a pause.
        let mut look = tokio::time::interval(LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        // One commit at a time.
        let mut writing = JoinSet::new();
        let mut open = true;
        loop {
            tokio::select! {
                Some(written) = writing.join_next() => {
                    let written: Result<Commit, StoreError> =
                        written.unwrap_or_else(|error| resume_unwind(error.into_panic()));
                    watch(Notice::Committed(&written?));
                    shell.keep_promises();
                }
                group = arrivals.take(), if open => {
                    let group = group.unwrap_or_default();
                    open = !group.is_empty();
                    let told = group.iter().all(|arrival| matches!(arrival, Arrival::Progress(..)));
                    shell.decide(group, &mut watch)?;
                    if open && told {
                        continue;
                    }
                    arrivals.in_force(shell.selector.mixture());
                }
                _ = look.tick(), if !shell.waiting.is_empty() || shell.at_work.is_empty() => {
                    // A stop before the first walker asks is followed by no message: agents wait for the end of the reactor.
                    if shell.waiting.is_empty() && !shell.stopping.load(Ordering::Relaxed) {
                        continue;
                    }
                }
            }
            if !writing.is_empty() {
                continue;
            }
            shell.promise(&mut watch).await?;
            if let Some(commit) = shell.decided.take() {
                writing.spawn(write(shell.store.clone(), commit));
            } else {
                shell.keep_promises();
                if !open || shell.is_over() {
                    // Whoever asks from now on has to be sent home by those who carry messages.
                    return Ok(if shell.selector.is_done() { Ended::Done } else { Ended::Stopped });
                }
            }
        }
    }
}

async fn write(store: Store, commit: Commit) -> Result<Commit, StoreError> {
    let begun = Instant::now();
    store.commit(&commit).await?;
    log::committed(&commit, begun.elapsed());
    Ok(commit)
}

/// Structures that a commit accepts: as many jobs, at most, come to the queue.
fn accepted(commit: &Commit) -> u64 {
    commit.candidates.iter().filter(|candidate| candidate.fate == Fate::Accepted).count() as u64
}

impl Shell {
    fn new(selector: Selector, store: Store, stopping: Arc<AtomicBool>, queue_limit: u64) -> Self {
        Self {
            selector,
            store,
            stopping,
            queue_limit,
            decided: None,
            waiting: VecDeque::new(),
            promised: Vec::new(),
            at_work: HashMap::new(),
            costs: HashMap::new(),
            unfinished: None,
            paused_at: None,
        }
    }

    /// Takes a group in, in the order in which it arrived.
    fn decide(
        &mut self,
        group: Vec<Arrival>,
        watch: &mut impl FnMut(Notice<'_>),
    ) -> Result<(), ReactorError> {
        for arrival in group {
            let commit = match arrival {
                Arrival::Progress(walk, progress) => {
                    watch(Notice::Progress(walk, progress));
                    None
                }
                Arrival::Free { walker, report, reply } => {
                    self.at_work.remove(&walker);
                    self.waiting.push_back((walker, reply));
                    match report.filter(|report| !self.is_in_hand(report.walk)) {
                        Some(report) => {
                            self.costs.remove(&report.walk);
                            self.selector.examined(report)?
                        }
                        None => None,
                    }
                }
                Arrival::Gone { walker, fault } => self.gone(walker, fault)?,
            };
            if let Some(commit) = commit {
                if let Some((most, _)) = &mut self.unfinished {
                    *most += accepted(&commit);
                    self.selector.set_unfinished_jobs(*most);
                }
                group::append(self.decided.get_or_insert_default(), commit);
            }
        }
        Ok(())
    }

    /// Whether a walker has a turn of the walk in hand, or is about to be given it. One that was taken for dead and comes
    /// back with a report cannot speak for a walk that was handed on.
    fn is_in_hand(&self, walk: WalkId) -> bool {
        let promised = self.promised.iter().filter_map(|promise| promise.work.as_ref());
        let mut in_hand = self.at_work.values().copied().chain(promised.map(|work| work.assignment.walk));
        in_hand.any(|other| other == walk)
    }

    /// Whether nobody works, waits, or will be given a turn.
    fn is_over(&self) -> bool {
        let no_more = self.selector.is_done() || self.stopping.load(Ordering::Relaxed);
        no_more && self.waiting.is_empty() && self.at_work.is_empty()
    }

    /// A walker was lost. If it had a turn in hand, another gets it, unless it is the turn that kills them.
    fn gone(&mut self, walker: u32, fault: bool) -> Result<Option<Commit>, ReactorError> {
        if let Some(index) = self.promised.iter().position(|promise| promise.walker == walker) {
            if let Some(work) = self.promised.remove(index).work {
                self.selector.lost(work.assignment.walk);
            }
            return Ok(None);
        }
        let Some(walk) = self.at_work.remove(&walker) else { return Ok(None) };
        warn!(walker, walk = walk.0, fault, "a walker was lost with a turn in hand");
        if fault {
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

    /// Chooses turns for waiting walkers as far as there are any, or that they go home.
    async fn promise(&mut self, watch: &mut impl FnMut(Notice<'_>)) -> Result<(), ReactorError> {
        if self.waiting.is_empty() {
            return Ok(());
        }
        if self.stopping.load(Ordering::Relaxed) {
            self.send_home();
            return Ok(());
        }
        if self.is_queue_full(watch).await? {
            return Ok(());
        }
        self.look_for_pauses().await?;
        while let Some((walker, reply)) = self.waiting.pop_front() {
            match self.selector.next_turn() {
                Next::Turn(assignment) => {
                    let mixture = Arc::clone(self.selector.mixture());
                    let work = Some(Work { assignment: *assignment, mixture });
                    self.promised.push(Promise { walker, reply, work });
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

    /// Whether the label queue is full, or may be when what is decided has come to it: then it is looked at again after
    /// the commit. It is not counted each time, since for a while it grows by what is decided here and nothing else.
    async fn is_queue_full(&mut self, watch: &mut impl FnMut(Notice<'_>)) -> Result<bool, ReactorError> {
        let limit = self.selector.most_unfinished(self.queue_limit);
        if self.unfinished.is_some_and(|(most, at)| most <= limit && at.elapsed() < LOOK) {
            return Ok(false);
        }
        let unfinished = self.store.unfinished_jobs().await?;
        if unfinished > limit {
            watch(Notice::QueueFull(unfinished));
        }
        let most = unfinished + self.decided.as_ref().map_or(0, accepted);
        self.unfinished = Some((most, Instant::now()));
        self.selector.set_unfinished_jobs(most);
        Ok(most > limit)
    }

    /// Finds out which walks are to get no turn.
    async fn look_for_pauses(&mut self) -> Result<(), StoreError> {
        if self.paused_at.is_none_or(|at| at.elapsed() >= LOOK) {
            self.selector.set_paused(self.store.paused_walks().await?);
            self.paused_at = Some(Instant::now());
        }
        Ok(())
    }

    fn send_home(&mut self) {
        let home = |(walker, reply)| Promise { walker, reply, work: None };
        self.promised.extend(self.waiting.drain(..).map(home));
    }

    /// Sends the answers: all that they rest on is on the disk.
    fn keep_promises(&mut self) {
        for Promise { walker, reply, work } in self.promised.drain(..) {
            let walk = work.as_ref().map(|work| work.assignment.walk);
            match (reply.send(work), walk) {
                (Ok(()), Some(walk)) => {
                    debug!(walker, walk = walk.0, "gave a turn");
                    self.at_work.insert(walker, walk);
                }
                // A walker that is gone needs no answer, and another gets its turn.
                (Err(_), Some(walk)) => self.selector.lost(walk),
                (_, None) => {}
            }
        }
    }
}
