//! Progress of the tests, and the request to stop.

use std::sync::atomic::{AtomicU64, Ordering};

use tokio_util::sync::CancellationToken;

use crate::output::{Bar, count};

/// Counts finished structures.
pub struct ValidationProgress {
    bar: Bar,
    total: AtomicU64,
    done: AtomicU64,
    stop: CancellationToken,
}

impl ValidationProgress {
    pub fn new(bar: Bar, stop: CancellationToken) -> Self {
        Self { bar, total: AtomicU64::new(0), done: AtomicU64::new(0), stop }
    }

    /// Sets the number of pieces of work.
    pub fn begin(&self, total: usize) {
        self.total.store(total as u64, Ordering::Relaxed);
        self.bar.set_length(total as u64);
    }

    /// One more piece is done.
    pub fn advance(&self) {
        let done = self.done.fetch_add(1, Ordering::Relaxed) + 1;
        let left = self.total.load(Ordering::Relaxed).saturating_sub(done);
        self.bar.set(done, || format!("{} left", count(left, "test")));
    }

    /// Whether the work is to end.
    pub fn is_stopped(&self) -> bool {
        self.stop.is_cancelled()
    }
}
