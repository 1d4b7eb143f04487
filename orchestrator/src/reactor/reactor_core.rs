//! The core of the reactor: which walker waits for what, and which replies wait for a commit. Without clock, channel or
//! database: its shell, [`super::Reactor`], reads the store, writes the commits, and passes the time.

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::time::{Duration, Instant};

use store::records::{Commit, Fate};
use tokio::sync::oneshot;
use tokio_util::sync::CancellationToken;
use tracing::{debug, warn};
use wire::transport::{Incoming, WorkItem};
use wire::{CompletionCoefficients, WalkId};

use super::commit_batch;
use super::events::ReactorEvent;
use crate::selector::{Scheduling, Selector, SelectorError};

/// Interval between checks of a full label queue and of paused walks, and validity of the result.
pub(super) const POLL_INTERVAL: Duration = Duration::from_millis(200);
/// A walk ends after its assignment has crashed this many walkers.
const MAX_CRASHES: u32 = 3;

type WorkReply = oneshot::Sender<Option<WorkItem>>;

/// The state of a reactor, see the [module](self).
///
/// After each batch of events, and after each commit: read what [`Self::needs_unfinished_jobs`] and
/// [`Self::needs_paused_walks`] ask for, [`Self::schedule`], and write [`Self::take_commit`]. Call [`Self::send_replies`]
/// when it is written, or if there is none. One commit is written at a time.
pub struct ReactorCore {
    selector: Selector,
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

/// A reply to a walker.
struct PendingReply {
    walker: u32,
    reply: WorkReply,
    work: Option<WorkItem>,
}

/// Number of structures that a commit accepts: an upper bound of the jobs it adds to the queue.
fn accepted(commit: &Commit) -> u64 {
    commit.candidates.iter().filter(|candidate| candidate.fate == Fate::Accepted).count() as u64
}

impl ReactorCore {
    /// Walkers wait while more than `queue_limit` label jobs are unfinished. `stopping` shuts them down.
    pub fn new(selector: Selector, stopping: CancellationToken, queue_limit: u64) -> Self {
        Self {
            selector,
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

    /// The selector.
    pub fn selector(&self) -> &Selector {
        &self.selector
    }

    /// Gives the selector a model of completion, for later decisions.
    pub fn set_completion_model(&mut self, model: CompletionCoefficients) {
        self.selector.set_completion_model(model);
    }

    /// Ends walks, because a newer version of the potential is there.
    pub fn supersede_walks(&mut self) {
        let ended = self.selector.supersede_walks();
        commit_batch::append(self.decided.get_or_insert_default(), ended);
    }

    /// Number of walkers that wait for an assignment.
    pub fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// Handles messages in order of arrival, graded by the current mixture.
    ///
    /// # Errors
    /// A decision is impossible.
    pub fn receive(&mut self, batch: Vec<Incoming>) -> Result<(), SelectorError> {
        let (regrader, mixture) = (self.selector.regrader(), self.selector.mixture());
        let regraded = |incoming| match incoming {
            Incoming::Idle { walker, report, reply } => {
                let report = report.map(|report| regrader.regrade(report, mixture));
                ReactorEvent::Idle { walker, report, reply }
            }
            Incoming::Progress(walk, progress) => ReactorEvent::Progress(walk, progress),
            Incoming::Lost { walker, crashed } => ReactorEvent::Lost { walker, crashed },
        };
        let batch: Vec<ReactorEvent> = batch.into_iter().map(regraded).collect();
        batch.into_iter().try_for_each(|event| self.handle(event))
    }

    /// Handles an event.
    pub(super) fn handle(&mut self, event: ReactorEvent) -> Result<(), SelectorError> {
        let commit = match event {
            ReactorEvent::Progress(..) => None,
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
        Ok(())
    }

    /// Takes back the walk of a walker.
    fn take_back(&mut self, walker: u32) -> Option<WalkId> {
        let walk = self.selector.walk_of(walker);
        walk.inspect(|walk| self.selector.assignment_lost(*walk))
    }

    /// Whether no walker is busy, waiting, or will get an assignment.
    pub fn is_over(&self) -> bool {
        let no_more = self.selector.is_done() || self.stopping.is_cancelled();
        no_more && self.waiting.is_empty() && self.selector.assignments() == 0
    }

    /// Handles the loss of a walker. Its assignment goes to another walker, unless it has crashed too many.
    fn walker_lost(&mut self, walker: u32, crashed: bool) -> Result<Option<Commit>, SelectorError> {
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
                return self.selector.abandon_walk(walk, reason);
            }
        }
        Ok(None)
    }

    /// Whether walkers wait for work that they may get.
    fn has_idle_walkers(&self) -> bool {
        !self.waiting.is_empty() && !self.stopping.is_cancelled()
    }

    /// Whether the number of unfinished label jobs must be read before the next [`Self::schedule`]. It is not counted
    /// every time, because in the short term only the decisions made here add to it.
    pub fn needs_unfinished_jobs(&self, now: Instant) -> bool {
        let limit = self.selector.max_unfinished_jobs(self.queue_limit);
        let is_known = |(upper_bound, at): (u64, Instant)| {
            upper_bound <= limit && now.saturating_duration_since(at) < POLL_INTERVAL
        };
        self.has_idle_walkers() && !self.unfinished.is_some_and(is_known)
    }

    /// Sets the number of unfinished label jobs in the store. Returns whether there are too many for further assignments.
    pub fn set_unfinished_jobs(&mut self, unfinished: u64, now: Instant) -> bool {
        let upper_bound = unfinished + self.decided.as_ref().map_or(0, accepted);
        self.unfinished = Some((upper_bound, now));
        self.selector.set_unfinished_jobs(upper_bound);
        unfinished > self.selector.max_unfinished_jobs(self.queue_limit)
    }

    /// Whether the label queue is full, or may be after the pending commit; it is then checked again after that commit.
    fn is_queue_full(&self) -> bool {
        let limit = self.selector.max_unfinished_jobs(self.queue_limit);
        self.unfinished.is_some_and(|(upper_bound, _)| upper_bound > limit)
    }

    /// Whether the paused walks must be read before the next [`Self::schedule`].
    pub fn needs_paused_walks(&self, now: Instant) -> bool {
        let is_old = |at| now.saturating_duration_since(at) >= POLL_INTERVAL;
        self.has_idle_walkers() && !self.is_queue_full() && self.paused_polled_at.is_none_or(is_old)
    }

    /// Sets which walks are paused.
    pub fn set_paused_walks(&mut self, walks: BTreeSet<WalkId>, now: Instant) {
        self.selector.set_paused(walks);
        self.paused_polled_at = Some(now);
    }

    /// Assigns work to idle walkers as far as possible, or shuts them down.
    pub fn schedule(&mut self) {
        if self.stopping.is_cancelled() {
            self.dismiss_waiting();
        }
        if self.is_queue_full() {
            return;
        }
        while let Some((walker, reply)) = self.waiting.pop_front() {
            match self.selector.next_assignment(walker) {
                Scheduling::Assign(assignment) => {
                    let mixture = self.selector.mixture().clone();
                    let work = Some(WorkItem { assignment: *assignment, mixture });
                    self.pending_replies.push(PendingReply { walker, reply, work });
                }
                Scheduling::Wait => {
                    self.waiting.push_front((walker, reply));
                    return;
                }
                Scheduling::Done => {
                    self.waiting.push_front((walker, reply));
                    self.dismiss_waiting();
                }
            }
        }
    }

    fn dismiss_waiting(&mut self) {
        let dismissal = |(walker, reply)| PendingReply { walker, reply, work: None };
        self.pending_replies.extend(self.waiting.drain(..).map(dismissal));
    }

    /// The decisions to write now, if there are any.
    pub fn take_commit(&mut self) -> Option<Commit> {
        self.decided.take()
    }

    /// Sends the pending replies, after everything they depend on is on disk.
    pub fn send_replies(&mut self) {
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
