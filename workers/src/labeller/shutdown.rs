//! Shutdown requests to labellers.

use tokio::sync::watch;

/// The requests to a labeller. Every change wakes all waiters.
#[derive(Debug, Default)]
pub struct Shutdown(watch::Sender<ShutdownState>);

/// The requests at one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct ShutdownState {
    /// No more jobs will be queued: exit when there are none.
    pub no_more_jobs: bool,
    /// Exit after the current label.
    pub stop: bool,
}

impl Shutdown {
    /// Requests to exit after the current label.
    pub fn stop(&self) {
        self.change(|state| state.stop = true);
    }

    /// Whether a stop was requested.
    pub fn is_stopping(&self) -> bool {
        self.state().stop
    }

    /// Sets whether no more jobs will be queued, as far as is known now. If so, the labeller exits when there are
    /// none.
    pub fn set_no_more_jobs(&self, no_more_jobs: bool) {
        self.change(|state| state.no_more_jobs = no_more_jobs);
    }

    pub(super) fn state(&self) -> ShutdownState {
        *self.0.borrow()
    }

    /// Waits until the state differs from `before`.
    pub(super) async fn changed_from(&self, before: ShutdownState) {
        let mut changes = self.0.subscribe();
        // The sender lives as long as this borrow.
        let _ = changes.wait_for(|state| *state != before).await;
    }

    /// Waits for a stop request.
    pub(super) async fn stop_requested(&self) {
        let mut changes = self.0.subscribe();
        let _ = changes.wait_for(|state| state.stop).await;
    }

    fn change(&self, change: impl FnOnce(&mut ShutdownState)) {
        self.0.send_if_modified(|state| {
            let before = *state;
            change(state);
            *state != before
        });
    }
}
