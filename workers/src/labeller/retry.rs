//! Retries writes while the database is busy or the disk full.

use std::time::{Duration, Instant};

use store::StoreError;
use tokio_util::sync::CancellationToken;

/// Time between two tries.
const RETRY_INTERVAL: Duration = Duration::from_secs(1);
/// How long to retry after a stop request.
const STOP_TIMEOUT: Duration = Duration::from_secs(60);

/// Calls `write` until it succeeds, fails permanently, or a minute has passed since `stop` was cancelled.
///
/// # Errors
/// The last error of `write`.
pub async fn retry_until_written<T, F: Future<Output = Result<T, StoreError>>>(
    stop: &CancellationToken,
    write: impl FnMut() -> F,
) -> Result<T, StoreError> {
    retry_for(RETRY_INTERVAL, STOP_TIMEOUT, stop, write).await
}

async fn retry_for<T, F: Future<Output = Result<T, StoreError>>>(
    interval: Duration,
    timeout: Duration,
    stop: &CancellationToken,
    mut write: impl FnMut() -> F,
) -> Result<T, StoreError> {
    let mut asked_to_stop = None;
    loop {
        let error = match write().await {
            Err(error) if error.is_transient() => error,
            done => return done,
        };
        if stop.is_cancelled() && asked_to_stop.get_or_insert_with(Instant::now).elapsed() >= timeout {
            return Err(error);
        }
        tokio::time::sleep(interval).await;
    }
}

#[cfg(test)]
mod tests {
    use std::future::ready;

    use super::*;

    const SHORT: Duration = Duration::from_millis(1);

    #[tokio::test]
    async fn writes_are_retried_until_success_or_a_permanent_error() {
        let stop = CancellationToken::new();
        let mut tries = 0;
        let written = retry_for(SHORT, Duration::ZERO, &stop, || {
            tries += 1;
            ready(match tries {
                1..20 => Err(StoreError::Busy),
                20..40 => Err(StoreError::DiskFull),
                _ => Ok(tries),
            })
        });
        assert_eq!(written.await.unwrap(), 40);
        let mut tries = 0;
        let refused = retry_for(SHORT, Duration::ZERO, &stop, || {
            tries += 1;
            ready(Err::<(), _>(if tries < 3 { StoreError::Busy } else { StoreError::ReadOnly }))
        });
        assert!(matches!(refused.await, Err(StoreError::ReadOnly)));
        assert_eq!(tries, 3);
    }

    #[tokio::test]
    async fn retries_continue_for_a_while_after_a_stop_request() {
        let (stop, mut tries, mut asked) = (CancellationToken::new(), 0, None);
        let timeout = Duration::from_millis(50);
        let full = retry_for(SHORT, timeout, &stop, || {
            tries += 1;
            if tries == 20 {
                stop.cancel();
                asked = Some(Instant::now());
            }
            ready(Err::<(), _>(StoreError::DiskFull))
        });
        assert!(matches!(full.await, Err(StoreError::DiskFull)));
        assert!(tries > 20 && asked.unwrap().elapsed() >= timeout, "{tries} tries");
    }
}
