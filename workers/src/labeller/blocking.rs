//! Slow work.

use tokio::task::spawn_blocking;

/// Runs slow work on a thread of its own. A panic in it propagates to the caller.
pub(super) async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    spawn_blocking(work).await.unwrap_or_else(|crash| std::panic::resume_unwind(crash.into_panic()))
}
