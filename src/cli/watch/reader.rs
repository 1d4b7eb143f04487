//! What is read of a campaign at each look: by the same code as `calmwalk status` and `queue` read it, in short transactions that
//! keep nobody waiting.

use std::time::Duration;

use store::{Job, JobState, Location, RecentDecision, Store};
use tokio::sync::{mpsc, watch};
use tokio::time::timeout;

use super::state::{Jobs, WINDOW};
use crate::cli::status::Snapshot;
use crate::exit_status::Failure;

/// Jobs of a state that are read, at most.
const JOBS: u32 = 300;

/// What was seen at one look.
#[derive(Debug)]
pub struct Seen {
    /// As `calmwalk status` shows it.
    pub snapshot: Snapshot,
    /// Which jobs were asked for.
    pub which: Jobs,
    /// The first of them, in the order in which they will be labelled.
    pub jobs: Vec<Job>,
    /// Decisions since the look before, newest first.
    pub decisions: Vec<RecentDecision>,
}

/// Looks at a campaign.
pub struct Reader {
    location: Location,
    /// A server's connections are kept. A file is opened at each look: it may be that of another campaign by then, or be written to
    /// by a campaign that did not run before.
    server: Option<Store>,
    last: i64,
}

impl Reader {
    /// Nothing is read yet.
    pub fn new(location: Location) -> Self {
        Self { location, server: None, last: 0 }
    }

    /// Looks once.
    pub async fn look(&mut self, which: Jobs) -> Result<Seen, Failure> {
        let store = match &self.server {
            Some(store) => store.clone(),
            None => Store::open_read_only(&self.location).await?,
        };
        let seen = self.read(&store, which).await;
        match &self.location {
            Location::Directory(_) => store.close().await,
            Location::Server(_) => self.server = Some(store),
        }
        seen
    }

    async fn read(&mut self, store: &Store, which: Jobs) -> Result<Seen, Failure> {
        let snapshot = Snapshot::of(store).await?;
        let mut jobs = Vec::new();
        for state in which.states() {
            jobs.extend(store.queue_list(Some(*state), JOBS, 0).await?);
        }
        let decisions = store.newest_decisions(self.last, WINDOW as u32).await?;
        self.last = decisions.first().map_or(self.last, |newest| newest.sequence);
        Ok(Seen { snapshot, which, jobs, decisions })
    }
}

impl Jobs {
    /// Those that the pane shows together.
    fn states(self) -> &'static [JobState] {
        match self {
            Self::Waiting => &[JobState::Leased, JobState::Queued],
            Self::Failed => &[JobState::Failed],
            Self::Dropped => &[JobState::Dropped],
            Self::Labelled => &[JobState::Labelled],
        }
    }
}

/// Looks without end, from a task.
pub struct Looks {
    seen: mpsc::Receiver<Result<Seen, Failure>>,
    wishes: watch::Sender<Jobs>,
}

impl Looks {
    /// Begins.
    pub fn begin(reader: Reader, every: Duration) -> Self {
        let (wishes, wished) = watch::channel(Jobs::default());
        let (send, seen) = mpsc::channel(1);
        tokio::spawn(keep(reader, every, wished, send));
        Self { seen, wishes }
    }

    /// What was seen at the next look; `None` if there will be no more.
    pub async fn next(&mut self) -> Option<Result<Seen, Failure>> {
        self.seen.recv().await
    }

    /// Looks at once, and at these jobs from now on.
    pub fn now(&self, jobs: Jobs) {
        self.wishes.send_replace(jobs);
    }
}

async fn keep(
    mut reader: Reader,
    every: Duration,
    mut wished: watch::Receiver<Jobs>,
    send: mpsc::Sender<Result<Seen, Failure>>,
) {
    loop {
        if let Ok(Err(_)) = timeout(every, wished.changed()).await {
            return;
        }
        let jobs = *wished.borrow_and_update();
        if send.send(reader.look(jobs).await).await.is_err() {
            return;
        }
    }
}
