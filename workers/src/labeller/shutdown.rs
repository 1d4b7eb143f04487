//! Shutdown requests to labellers.

use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

/// The requests to a labeller.
#[derive(Debug, Default)]
pub struct Shutdown {
    /// Cancelled to request that the labeller exits after the current label.
    pub stop: CancellationToken,
    no_more_jobs: watch::Sender<bool>,
}

impl Shutdown {
    /// Stops labellers when `stop` is cancelled.
    pub fn new(stop: CancellationToken) -> Self {
        Self { stop, ..Self::default() }
    }

    /// Sets whether no more jobs will be queued, as far as is known now. If so, the labeller exits when there are
    /// none.
    pub fn set_no_more_jobs(&self, no_more_jobs: bool) {
        self.no_more_jobs.send_if_modified(|before| std::mem::replace(before, no_more_jobs) != no_more_jobs);
    }

    pub(super) fn no_more_jobs(&self) -> bool {
        *self.no_more_jobs.borrow()
    }

    /// Waits until a stop is requested or [`Self::no_more_jobs`] differs from `before`.
    pub(super) async fn changed_from(&self, before: bool) {
        let mut changes = self.no_more_jobs.subscribe();
        tokio::select! {
            () = self.stop.cancelled() => {}
            // The sender lives as long as this borrow.
            _ = changes.wait_for(|now| *now != before) => {}
        }
    }
}
