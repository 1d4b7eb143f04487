//! Drives the selector: receives reports, writes every commit to the store, and then answers.
//!
//! Writing a transaction to disk takes longer than most decisions. Reports that arrive during a commit are therefore
//! decided one after the other in the meantime, and committed together afterwards. A walker is answered when the
//! decision about its report, and all earlier decisions, are on disk.

pub mod commit_batch;
mod events;
mod log;

use std::collections::{HashMap, VecDeque};
use std::panic::resume_unwind;
use std::pin::pin;
use std::sync::Arc;
use std::time::{Duration, Instant};

use futures_util::FutureExt;
use store::records::{Commit, Fate};
use store::{Store, StoreError};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;
use tracing::{debug, warn};
use wire::messages::WalkProgress;
use wire::transport::{Incoming, WorkItem};
use wire::{CompletionCoefficients, WalkId};

use self::events::{EventStream, ReactorEvent};
use crate::selector::{Scheduling, Selector, SelectorError};

/// Interval between checks of a full label queue and of paused walks, and validity of the result.
const POLL_INTERVAL: Duration = Duration::from_millis(200);
/// A walk ends after its assignment has crashed this many walkers.
const MAX_CRASHES: u32 = 3;

/// Why the reactor failed.
#[derive(Debug, thiserror::Error)]
pub enum ReactorError {
    /// An error of the selector.
    #[error(transparent)]
    Selector(#[from] SelectorError),
    /// An error of the store.
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// A notification for display.
#[derive(Debug)]
pub enum Notice<'a> {
    /// Current state of a walk.
    Progress(WalkId, WalkProgress),
    /// A commit that has been written.
    Committed(&'a Commit),
    /// Walkers wait because this many label jobs are unfinished.
    QueueFull(u64),
    /// Number of walkers that are busy from now on.
    Walkers {
        /// Walkers with an assignment.
        busy: usize,
        /// All connected walkers.
        all: usize,
    },
}

/// How the reactor ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RunOutcome {
    /// Every walk has ended.
    Finished,
    /// Walks are left, but a stop was requested or all walkers have exited. The campaign can be continued.
    Stopped,
}

/// Configuration of the reactor.
pub struct Reactor {
    /// The selector.
    pub selector: Selector,
    /// The campaign's database.
    pub store: Store,
    /// Messages of walkers.
    pub incoming: mpsc::Receiver<Incoming>,
    /// Cancelled to stop, for example by Ctrl-C: walkers are shut down and their walks can be continued later.
    pub stopping: CancellationToken,
    /// Cancelled when a newer version of the potential is there: biased walks end, to make room for it.
    pub walks_end: CancellationToken,
    /// Walkers wait while more label jobs than this are unfinished, unless the selector raises its threshold first.
    pub queue_limit: u64,
    /// The newest model of the completion of labels, from the task that learns it. The selector has it before the next
    /// decisions. `None` if nothing learns one.
    pub completion: Option<watch::Receiver<Option<CompletionCoefficients>>>,
}

/// State of the running reactor.
struct ReactorState {
    selector: Selector,
    store: Store,
    stopping: CancellationToken,
    queue_limit: u64,
    /// Decisions that are not being written yet.
    decided: Option<Commit>,
    /// Idle walkers, in order of arrival.
    waiting: VecDeque<(u32, WorkReply)>,
    /// Replies that wait for the commit before them.
    pending_replies: Vec<PendingReply>,
    /// Number of walkers that crashed with the current assignment of a walk.
    crash_counts: HashMap<WalkId, u32>,
    /// Upper bound of the number of unfinished label jobs, and when it was determined.
    unfinished: Option<(u64, Instant)>,
    /// When the list of paused walks was last read.
    paused_polled_at: Option<Instant>,
}

type WorkReply = oneshot::Sender<Option<WorkItem>>;

/// A reply to a walker.
struct PendingReply {
    walker: u32,
    reply: WorkReply,
    work: Option<WorkItem>,
}

impl Reactor {
    /// Runs until no walker is busy and there is nothing to assign, because all walks have ended or a stop was
    /// requested; or until no walker can connect any more.
    pub async fn run(self, mut watch: impl FnMut(Notice<'_>)) -> Result<RunOutcome, ReactorError> {
        let mut events =
            EventStream::new(self.incoming, self.selector.regrader().clone(), self.selector.mixture());
        let stopping = self.stopping.clone();
        let mut stop = pin!(stopping.cancelled().fuse());
        let walks_end = self.walks_end;
        let mut newer_version = pin!(walks_end.cancelled().fuse());
        let mut completion = self.completion;
        let mut state = ReactorState::new(self.selector, self.store, self.stopping, self.queue_limit);
        // An interval, not a timeout since the last message: busy walkers may report progress continuously.
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
                    state.receive_completion_model(&mut completion);
                    let only_progress = batch.iter().all(|event| matches!(event, ReactorEvent::Progress(..)));
                    state.decide(batch, &mut watch)?;
                    if open && only_progress {
                        continue;
                    }
                    events.set_mixture(state.selector.mixture());
                }
                _ = poll.tick(), if !state.waiting.is_empty() => {}
                () = &mut stop => {}
                () = &mut newer_version => {
                    let ended = state.selector.supersede_walks();
                    commit_batch::append(state.decided.get_or_insert_default(), ended);
                }
            }
            if !writing.is_empty() {
                continue;
            }
            state.schedule(&mut watch).await?;
            let busy = state.selector.assignments();
            watch(Notice::Walkers { busy, all: busy + state.waiting.len() });
            if let Some(commit) = state.decided.take() {
                writing.spawn(write(state.store.clone(), commit));
            } else {
                state.send_replies();
                if !open || state.is_over() {
                    // From now on the transports shut down walkers that ask for work.
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
    let start = Instant::now();
    store.commit(&commit).await?;
    log::committed(&commit, start.elapsed());
    Ok(commit)
}

/// Number of structures that a commit accepts: an upper bound of the jobs it adds to the queue.
fn accepted(commit: &Commit) -> u64 {
    commit.candidates.iter().filter(|candidate| candidate.fate == Fate::Accepted).count() as u64
}

impl ReactorState {
    fn new(selector: Selector, store: Store, stopping: CancellationToken, queue_limit: u64) -> Self {
        Self {
            selector,
            store,
            stopping,
            queue_limit,
            decided: None,
            waiting: VecDeque::new(),
            pending_replies: Vec::new(),
            crash_counts: HashMap::new(),
            unfinished: None,
            paused_polled_at: None,
        }
    }

    /// Gives the selector the newest model of completion, if there is a new one.
    fn receive_completion_model(
        &mut self,
        completion: &mut Option<watch::Receiver<Option<CompletionCoefficients>>>,
    ) {
        let newest = completion.as_mut().filter(|model| model.has_changed().unwrap_or(false));
        let newest = newest.and_then(|model| model.borrow_and_update().clone());
        newest.into_iter().for_each(|model| self.selector.set_completion_model(model));
    }

    /// Handles a batch of events in order of arrival.
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
                    self.take_back(walker);
                    self.waiting.push_back((walker, reply));
                    // A report is ignored if its sender was considered lost and another walker has the walk now.
                    match report.filter(|report| !self.selector.is_assigned(report.walk)) {
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

    /// Takes back the walk of a walker.
    fn take_back(&mut self, walker: u32) -> Option<WalkId> {
        let walk = self.selector.walk_of(walker);
        walk.inspect(|walk| self.selector.assignment_lost(*walk))
    }

    /// Whether no walker is busy, waiting, or will get an assignment.
    fn is_over(&self) -> bool {
        let no_more = self.selector.is_done() || self.stopping.is_cancelled();
        no_more && self.waiting.is_empty() && self.selector.assignments() == 0
    }

    /// Handles the loss of a walker. Its assignment goes to another walker, unless it has crashed too many.
    fn walker_lost(&mut self, walker: u32, crashed: bool) -> Result<Option<Commit>, ReactorError> {
        self.waiting.retain(|(waiting, _)| *waiting != walker);
        let replies = self.pending_replies.len();
        self.pending_replies.retain(|pending| pending.walker != walker);
        let Some(walk) = self.take_back(walker) else { return Ok(None) };
        if self.pending_replies.len() < replies {
            // It never received the assignment.
            return Ok(None);
        }
        warn!(walker, walk = walk.0, crashed, "a walker was lost with an assignment");
        if crashed {
            let crashes = self.crash_counts.entry(walk).or_default();
            *crashes += 1;
            if *crashes == MAX_CRASHES {
                // Without the details: the last output of a process is not reproducible.
                let reason = format!("{MAX_CRASHES} walkers crashed in this assignment");
                return Ok(self.selector.abandon_walk(walk, reason)?);
            }
        }
        Ok(None)
    }

    /// Assigns work to idle walkers as far as possible, or shuts them down.
    async fn schedule(&mut self, watch: &mut impl FnMut(Notice<'_>)) -> Result<(), ReactorError> {
        if self.waiting.is_empty() {
            return Ok(());
        }
        if self.stopping.is_cancelled() {
            self.dismiss_waiting();
            return Ok(());
        }
        if self.is_queue_full(watch).await? {
            return Ok(());
        }
        self.refresh_paused().await?;
        while let Some((walker, reply)) = self.waiting.pop_front() {
            match self.selector.next_assignment(walker) {
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

    /// Whether the label queue is full, or may be after the pending commit; it is then checked again after that commit.
    /// It is not counted every time, because in the short term only the decisions made here add to it.
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

    /// Reads which walks are paused.
    async fn refresh_paused(&mut self) -> Result<(), StoreError> {
        if self.paused_polled_at.is_none_or(|at| at.elapsed() >= POLL_INTERVAL) {
            self.selector.set_paused(self.store.paused_walks().await?);
            self.paused_polled_at = Some(Instant::now());
        }
        Ok(())
    }

    fn dismiss_waiting(&mut self) {
        let dismissal = |(walker, reply)| PendingReply { walker, reply, work: None };
        self.pending_replies.extend(self.waiting.drain(..).map(dismissal));
    }

    /// Sends the pending replies, after everything they depend on is on disk.
    fn send_replies(&mut self) {
        for PendingReply { walker, reply, work } in self.pending_replies.drain(..) {
            let walk = work.as_ref().map(|work| work.assignment.walk);
            match (reply.send(work), walk) {
                (Ok(()), Some(walk)) => debug!(walker, walk = walk.0, "sent an assignment"),
                // The walker has exited; another walker gets its assignment.
                (Err(_), Some(walk)) => self.selector.assignment_lost(walk),
                (_, None) => {}
            }
        }
    }
}
