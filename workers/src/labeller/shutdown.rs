//! When a labeller may go home.

use tokio::sync::watch;

/// What is state of a labeller. Whoever waits for it is woken by every change.
#[derive(Debug, Default)]
pub struct Shutdown(watch::Sender<ShutdownState>);

/// What is state at one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct ShutdownState {
    /// No more jobs will be queued: go home once there are none.
    pub no_more_jobs: bool,
    /// Go home after the label in hand.
    pub stop: bool,
}

impl Shutdown {
    /// Go home after the label in hand.
    pub fn stop(&self) {
        self.change(|state| state.stop = true);
    }

    /// Whether somebody asked to stop.
    pub fn is_stopping(&self) -> bool {
        self.state().stop
    }

    /// Whether jobs may still be queued, as far as is known now: if not, go home once there are none.
    pub fn set_no_more_jobs(&self, no_more_jobs: bool) {
        self.change(|state| state.no_more_jobs = no_more_jobs);
    }

    pub(super) fn state(&self) -> ShutdownState {
        *self.0.borrow()
    }

    /// Waits until something else is state than `before`.
    pub(super) async fn changed_from(&self, before: ShutdownState) {
        let mut changes = self.0.subscribe();
        // The sender lives as long as this borrows it.
        let _ = changes.wait_for(|state| *state != before).await;
    }

    /// Waits until somebody asks to stop.
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
