//! When a labeller may go home.

use tokio::sync::watch;

/// What is wanted of a labeller. Whoever waits for it is woken by every change.
#[derive(Debug, Default)]
pub struct Closing(watch::Sender<Wanted>);

/// What is wanted at one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Wanted {
    /// No more jobs will be queued: go home once there are none.
    pub no_more_jobs: bool,
    /// Go home after the label in hand.
    pub stop: bool,
}

impl Closing {
    /// Go home after the label in hand.
    pub fn stop(&self) {
        self.change(|wanted| wanted.stop = true);
    }

    /// Whether somebody asked to stop.
    pub fn is_stopping(&self) -> bool {
        self.wanted().stop
    }

    /// Whether jobs may still be queued, as far as is known now: if not, go home once there are none.
    pub fn set_no_more_jobs(&self, no_more_jobs: bool) {
        self.change(|wanted| wanted.no_more_jobs = no_more_jobs);
    }

    pub(super) fn wanted(&self) -> Wanted {
        *self.0.borrow()
    }

    /// Waits until something else is wanted than `before`.
    pub(super) async fn other_than(&self, before: Wanted) {
        let mut changes = self.0.subscribe();
        // The sender lives as long as this borrows it.
        let _ = changes.wait_for(|wanted| *wanted != before).await;
    }

    /// Waits until somebody asks to stop.
    pub(super) async fn stopped(&self) {
        let mut changes = self.0.subscribe();
        let _ = changes.wait_for(|wanted| wanted.stop).await;
    }

    fn change(&self, change: impl FnOnce(&mut Wanted)) {
        self.0.send_if_modified(|wanted| {
            let before = *wanted;
            change(wanted);
            *wanted != before
        });
    }
}
