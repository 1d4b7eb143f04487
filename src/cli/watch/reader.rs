//! Polls a campaign with the code of `calmwalk status` and `queue`, in short transactions that do not block a run.

use std::time::Duration;

use monitor::Snapshot;
use store::{Location, Store};
use tokio::sync::{mpsc, watch};
use tokio::time::timeout;

use super::messages::{JobView, Reading, WINDOW};
use crate::exit_status::CommandError;

/// Maximum number of jobs read per state.
const MAX_JOBS: u32 = 300;

/// Reads a campaign.
pub struct CampaignReader {
    location: Location,
    /// Connections to a server stay open. A file is opened for each poll, because it may have been replaced, or a run may have
    /// started.
    server: Option<Store>,
    last: i64,
}

impl CampaignReader {
    /// Reads nothing yet.
    pub fn new(location: Location) -> Self {
        Self { location, server: None, last: 0 }
    }

    /// Polls once.
    pub async fn poll(&mut self, view: JobView) -> Result<Reading, CommandError> {
        let store = match &self.server {
            Some(store) => store.clone(),
            None => Store::open_read_only(&self.location).await?,
        };
        let reading = self.read(&store, view).await;
        match &self.location {
            Location::Directory(_) => store.close().await,
            Location::Server(_) => self.server = Some(store),
        }
        reading
    }

    async fn read(&mut self, store: &Store, view: JobView) -> Result<Reading, CommandError> {
        let snapshot = Snapshot::read(store).await?;
        let mut jobs = Vec::new();
        for state in view.states() {
            jobs.extend(store.queue_list(Some(*state), MAX_JOBS, 0).await?);
        }
        let decisions = store.newest_decisions(self.last, WINDOW as u32).await?;
        self.last = decisions.first().map_or(self.last, |newest| newest.sequence);
        Ok(Reading { snapshot, view, jobs, decisions })
    }
}

/// A task that polls at an interval.
pub struct Poller {
    readings: mpsc::Receiver<Result<Reading, CommandError>>,
    view: watch::Sender<JobView>,
}

impl Poller {
    /// Starts the task.
    pub fn start(reader: CampaignReader, interval: Duration) -> Self {
        let (view, requested) = watch::channel(JobView::default());
        let (sender, readings) = mpsc::channel(1);
        tokio::spawn(poll_repeatedly(reader, interval, requested, sender));
        Self { readings, view }
    }

    /// The result of the next poll; `None` if the task has ended.
    pub async fn next(&mut self) -> Option<Result<Reading, CommandError>> {
        self.readings.recv().await
    }

    /// Polls at once, with this view from now on.
    pub fn poll_now(&self, view: JobView) {
        self.view.send_replace(view);
    }
}

async fn poll_repeatedly(
    mut reader: CampaignReader,
    interval: Duration,
    mut requested: watch::Receiver<JobView>,
    sender: mpsc::Sender<Result<Reading, CommandError>>,
) {
    loop {
        if let Ok(Err(_)) = timeout(interval, requested.changed()).await {
            return;
        }
        let view = *requested.borrow_and_update();
        if sender.send(reader.poll(view).await).await.is_err() {
            return;
        }
    }
}
