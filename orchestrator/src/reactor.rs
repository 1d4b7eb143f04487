//! The shell round the selector: takes reports from the channel, has every commit written, then answers.
//!
//! To have a transaction on the disk takes longer than most decisions. So what arrives during a commit is decided
//! meanwhile, one after the other, and committed as one group when that commit is done. Everybody is answered when
//! what was decided about them, and all before it, is on the disk.

pub mod commit_batch;
mod events;
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
use wire::transport::{Incoming, WorkItem};

use self::events::{EventStream, ReactorEvent};
use crate::selector::{Scheduling, Selector, SelectorError};

/// How often a full label queue and paused walks are looked at again, and for how long what was found is good.
const POLL_INTERVAL: Duration = Duration::from_millis(200);
/// A turn may crashes so many walkers, which crashed with it in hand; then its walk is over.
const MAX_CRASHES: u32 = 3;

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
pub enum RunOutcome {
    /// Every walk is over.
    Finished,
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
struct ReactorState {
    selector: Selector,
    store: Store,
    stopping: Arc<AtomicBool>,
    queue_limit: u64,
    /// What is decided and not yet on its way to the disk.
    decided: Option<Commit>,
    /// Walkers that wait for a turn, in the order in which they came.
    waiting: VecDeque<(u32, Reply)>,
    /// Those whose answer is known and waits for the commit before it.
    pending_replies: Vec<PendingReply>,
    /// The walk that each of the others has in hand.
    at_work: HashMap<u32, WalkId>,
    /// Walkers that crashed with the present turn of a walk.
    crash_counts: HashMap<WalkId, u32>,
    /// Label jobs that are unfinished at most, and when they were counted.
    unfinished: Option<(u64, Instant)>,
    /// When it was last looked which walks people have paused.
    paused_polled_at: Option<Instant>,
}

type Reply = oneshot::Sender<Option<WorkItem>>;

/// The answer to a walker.
struct PendingReply {
    walker: u32,
    reply: Reply,
    work: Option<WorkItem>,
}

impl Reactor {
    /// Runs until no walker has a turn in hand and there is none to be given out, because all walks are over or because
    /// it is stopped; or until no walker can come any more.
    pub async fn run(self, mut watch: impl FnMut(Notice<'_>)) -> Result<RunOutcome, ReactorError> {
        let mut events =
            EventStream::new(self.incoming, self.selector.regrader().clone(), self.selector.mixture());
        let mut state = ReactorState::new(self.selector, self.store, self.stopping, self.queue_limit);
        // An interval, not a time since the last message: walkers at work may report progress without a pause.
        let mut poll = tokio::time::interval(POLL_INTERVAL);
        poll.set_missed_tick_behavior(MissedTickBehavior::Delay);
        // One commit at a time.
        let mut writing = JoinSet::new();
        let mut open = true;
        loop {
            tokio::select! {
                Some(written) = writing.join_next() => {
                    let written: Result<Commit, StoreError> =
                        written.unwrap_or_else(|error| resume_unwind(error.into_panic()));
                    watch(Notice::Committed(&written?));
                    state.send_replies();
                }
                batch = events.take(), if open => {
                    let batch = batch.unwrap_or_default();
                    open = !batch.is_empty();
                    let told = batch.iter().all(|event| matches!(event, ReactorEvent::Progress(..)));
                    state.decide(batch, &mut watch)?;
                    if open && told {
                        continue;
                    }
                    events.set_mixture(state.selector.mixture());
                }
                _ = poll.tick(), if !state.waiting.is_empty() || state.at_work.is_empty() => {
                    // A stop before the first walker asks is followed by no message: agents wait for the end of the reactor.
                    if state.waiting.is_empty() && !state.stopping.load(Ordering::Relaxed) {
                        continue;
                    }
                }
            }
            if !writing.is_empty() {
                continue;
            }
            state.schedule(&mut watch).await?;
            if let Some(commit) = state.decided.take() {
                writing.spawn(write(state.store.clone(), commit));
            } else {
                state.send_replies();
                if !open || state.is_over() {
                    // Whoever asks from now on has to be sent home by those who carry messages.
                    return Ok(if state.selector.is_done() {
                        RunOutcome::Finished
                    } else {
                        RunOutcome::Stopped
                    });
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

impl ReactorState {
    fn new(selector: Selector, store: Store, stopping: Arc<AtomicBool>, queue_limit: u64) -> Self {
        Self {
            selector,
            store,
            stopping,
            queue_limit,
            decided: None,
            waiting: VecDeque::new(),
            pending_replies: Vec::new(),
            at_work: HashMap::new(),
            crash_counts: HashMap::new(),
            unfinished: None,
            paused_polled_at: None,
        }
    }

    /// Takes a group in, in the order in which it arrived.
    fn decide(
        &mut self,
        batch: Vec<ReactorEvent>,
        watch: &mut impl FnMut(Notice<'_>),
    ) -> Result<(), ReactorError> {
        for event in batch {
            let commit = match event {
                ReactorEvent::Progress(walk, progress) => {
                    watch(Notice::Progress(walk, progress));
                    None
                }
                ReactorEvent::Idle { walker, report, reply } => {
                    self.at_work.remove(&walker);
                    self.waiting.push_back((walker, reply));
                    match report.filter(|report| !self.is_in_hand(report.walk)) {
                        Some(report) => {
                            self.crash_counts.remove(&report.walk);
                            self.selector.report_regraded(report)?
                        }
                        None => None,
                    }
                }
                ReactorEvent::Lost { walker, crashed } => self.walker_lost(walker, crashed)?,
            };
            if let Some(commit) = commit {
                if let Some((upper_bound, _)) = &mut self.unfinished {
                    *upper_bound += accepted(&commit);
                    self.selector.set_unfinished_jobs(*upper_bound);
                }
                commit_batch::append(self.decided.get_or_insert_default(), commit);
            }
        }
        Ok(())
    }

    /// Whether a walker has a turn of the walk in hand, or is about to be given it. One that was taken for dead and comes
    /// back with a report cannot speak for a walk that was handed on.
    fn is_in_hand(&self, walk: WalkId) -> bool {
        let pending_replies = self.pending_replies.iter().filter_map(|pending| pending.work.as_ref());
        let mut in_hand =
            self.at_work.values().copied().chain(pending_replies.map(|work| work.assignment.walk));
        in_hand.any(|other| other == walk)
    }

    /// Whether nobody works, waits, or will be given a turn.
    fn is_over(&self) -> bool {
        let no_more = self.selector.is_done() || self.stopping.load(Ordering::Relaxed);
        no_more && self.waiting.is_empty() && self.at_work.is_empty()
    }

    /// A walker was lost. If it had a turn in hand, another gets it, unless it is the turn that kills them.
    fn walker_lost(&mut self, walker: u32, crashed: bool) -> Result<Option<Commit>, ReactorError> {
        if let Some(index) = self.pending_replies.iter().position(|pending| pending.walker == walker) {
            if let Some(work) = self.pending_replies.remove(index).work {
                self.selector.assignment_lost(work.assignment.walk);
            }
            return Ok(None);
        }
        let Some(walk) = self.at_work.remove(&walker) else { return Ok(None) };
        warn!(walker, walk = walk.0, crashed, "a walker was lost with a turn in hand");
        if crashed {
            let crashes = self.crash_counts.entry(walk).or_default();
            *crashes += 1;
            if *crashes == MAX_CRASHES {
                // Not how: the last words of a process are not the same twice.
                let reason = format!("{MAX_CRASHES} walkers crashed in this turn");
                return Ok(self.selector.abandon_walk(walk, reason)?);
            }
        }
        self.selector.assignment_lost(walk);
        Ok(None)
    }

    /// Chooses turns for waiting walkers as far as there are any, or that they go home.
    async fn schedule(&mut self, watch: &mut impl FnMut(Notice<'_>)) -> Result<(), ReactorError> {
        if self.waiting.is_empty() {
            return Ok(());
        }
        if self.stopping.load(Ordering::Relaxed) {
            self.dismiss_waiting();
            return Ok(());
        }
        if self.is_queue_full(watch).await? {
            return Ok(());
        }
        self.refresh_paused().await?;
        while let Some((walker, reply)) = self.waiting.pop_front() {
            match self.selector.next_assignment() {
                Scheduling::Assign(assignment) => {
                    let mixture = Arc::clone(self.selector.mixture());
                    let work = Some(WorkItem { assignment: *assignment, mixture });
                    self.pending_replies.push(PendingReply { walker, reply, work });
                }
                Scheduling::Wait => {
                    self.waiting.push_front((walker, reply));
                    return Ok(());
                }
                Scheduling::Done => {
                    self.waiting.push_front((walker, reply));
                    self.dismiss_waiting();
                }
            }
        }
        Ok(())
    }

    /// Whether the label queue is full, or may be when what is decided has come to it: then it is looked at again after
    /// the commit. It is not counted each time, since for a while it grows by what is decided here and nothing else.
    async fn is_queue_full(&mut self, watch: &mut impl FnMut(Notice<'_>)) -> Result<bool, ReactorError> {
        let limit = self.selector.max_unfinished_jobs(self.queue_limit);
        if self
            .unfinished
            .is_some_and(|(upper_bound, at)| upper_bound <= limit && at.elapsed() < POLL_INTERVAL)
        {
            return Ok(false);
        }
        let unfinished = self.store.unfinished_jobs().await?;
        if unfinished > limit {
            watch(Notice::QueueFull(unfinished));
        }
        let upper_bound = unfinished + self.decided.as_ref().map_or(0, accepted);
        self.unfinished = Some((upper_bound, Instant::now()));
        self.selector.set_unfinished_jobs(upper_bound);
        Ok(upper_bound > limit)
    }

    /// Finds out which walks are to get no turn.
    async fn refresh_paused(&mut self) -> Result<(), StoreError> {
        if self.paused_polled_at.is_none_or(|at| at.elapsed() >= POLL_INTERVAL) {
            self.selector.set_paused(self.store.paused_walks().await?);
            self.paused_polled_at = Some(Instant::now());
        }
        Ok(())
    }

    fn dismiss_waiting(&mut self) {
        let home = |(walker, reply)| PendingReply { walker, reply, work: None };
        self.pending_replies.extend(self.waiting.drain(..).map(home));
    }

    /// Sends the answers: all that they rest on is on the disk.
    fn send_replies(&mut self) {
        for PendingReply { walker, reply, work } in self.pending_replies.drain(..) {
            let walk = work.as_ref().map(|work| work.assignment.walk);
            match (reply.send(work), walk) {
                (Ok(()), Some(walk)) => {
                    debug!(walker, walk = walk.0, "gave a turn");
                    self.at_work.insert(walker, walk);
                }
                // A walker that is gone needs no answer, and another gets its turn.
                (Err(_), Some(walk)) => self.selector.assignment_lost(walk),
                (_, None) => {}
            }
        }
    }
}
