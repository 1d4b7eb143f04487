//! Pauses while a batch system accepts no further job.

use std::time::Duration;

use tokio::time::sleep;

/// First time between two tries to submit a job while the batch system accepts none.
const MIN_FULL_PAUSE: Duration = Duration::from_secs(2);
/// Longest such time.
const MAX_FULL_PAUSE: Duration = Duration::from_secs(60);

/// Growing pauses between tries to submit a job.
pub struct FullPause(Duration);

impl FullPause {
    pub fn new() -> Self {
        Self(MIN_FULL_PAUSE)
    }

    /// Waits; the next pause is twice as long, up to a minute.
    pub async fn wait(&mut self) {
        sleep(self.0).await;
        self.0 = (2 * self.0).min(MAX_FULL_PAUSE);
    }
}
