//! Drives the selector: receives reports, writes every commit to the store, and then answers. The decisions about
//! walkers and replies are in a pure core ([`ReactorCore`]).
//!
//! Writing a transaction to disk takes longer than most decisions. Reports that arrive during a commit are therefore
//! decided one after the other in the meantime, and committed together afterwards. A walker is answered when the
//! decision about its report, and all earlier decisions, are on disk.

pub mod commit_batch;
mod events;
mod log;
mod reactor_core;

use std::panic::resume_unwind;
use std::pin::pin;
use std::time::Instant;

use futures_util::FutureExt;
use store::records::Commit;
use store::{Store, StoreError};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;
use wire::messages::WalkProgress;
use wire::transport::Incoming;
use wire::{CompletionCoefficients, WalkId};

use self::events::{EventStream, ReactorEvent};
use self::reactor_core::POLL_INTERVAL;
pub use self::reactor_core::ReactorCore;
use crate::selector::{Selector, SelectorError};

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
        let store = self.store;
        let mut core = ReactorCore::new(self.selector, self.stopping, self.queue_limit);
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
                    core.send_replies();
                }
                batch = events.take(), if open => {
                    let batch = batch.unwrap_or_default();
                    open = !batch.is_empty();
                    newest_completion_model(&mut completion).into_iter().for_each(|model| core.set_completion_model(model));
                    let only_progress = batch.iter().all(|event| matches!(event, ReactorEvent::Progress(..)));
                    for event in batch {
                        match event {
                            ReactorEvent::Progress(walk, progress) => watch(Notice::Progress(walk, progress)),
                            event => core.handle(event)?,
                        }
                    }
                    if open && only_progress {
                        continue;
                    }
                    events.set_mixture(core.selector().mixture());
                }
                _ = poll.tick(), if core.waiting() > 0 => {}
                () = &mut stop => {}
                () = &mut newer_version => core.supersede_walks(),
            }
            if !writing.is_empty() {
                continue;
            }
            read_store(&mut core, &store, &mut watch).await?;
            core.schedule();
            let busy = core.selector().assignments();
            watch(Notice::Walkers { busy, all: busy + core.waiting() });
            if let Some(commit) = core.take_commit() {
                writing.spawn(write(store.clone(), commit));
            } else {
                core.send_replies();
                if !open || core.is_over() {
                    // From now on the transports shut down walkers that ask for work.
                    return Ok(if core.selector().is_done() {
                        RunOutcome::Finished
                    } else {
                        RunOutcome::Stopped
                    });
                }
            }
        }
    }
}

/// Reads what the core needs for its next assignments.
async fn read_store(
    core: &mut ReactorCore,
    store: &Store,
    watch: &mut impl FnMut(Notice<'_>),
) -> Result<(), StoreError> {
    if core.needs_unfinished_jobs(Instant::now()) {
        let unfinished = store.unfinished_jobs().await?;
        if core.set_unfinished_jobs(unfinished, Instant::now()) {
            watch(Notice::QueueFull(unfinished));
        }
    }
    if core.needs_paused_walks(Instant::now()) {
        core.set_paused_walks(store.paused_walks().await?, Instant::now());
    }
    Ok(())
}

/// The newest model of completion, if there is a new one.
fn newest_completion_model(
    completion: &mut Option<watch::Receiver<Option<CompletionCoefficients>>>,
) -> Option<CompletionCoefficients> {
    let newest = completion.as_mut().filter(|model| model.has_changed().unwrap_or(false));
    newest.and_then(|model| model.borrow_and_update().clone())
}

async fn write(store: Store, commit: Commit) -> Result<Commit, StoreError> {
    let start = Instant::now();
    store.commit(&commit).await?;
    log::committed(&commit, start.elapsed());
    Ok(commit)
}
