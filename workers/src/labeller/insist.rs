//! What has to be written, however busy or full the database is.

use std::time::{Duration, Instant};

use store::StoreError;

use super::Closing;

/// Between two tries.
const PAUSE: Duration = Duration::from_secs(1);
/// How long it is tried after the labeller was asked to stop: whoever asked will not wait for ever.
const LAST_TRIES: Duration = Duration::from_secs(60);

/// Calls `write` until it succeeds, fails for good, or has been of no use for a minute after `closing` asked to stop.
///
/// # Errors
/// The last one of `write`.
pub async fn insist<T, F: Future<Output = Result<T, StoreError>>>(
    closing: &Closing,
    write: impl FnMut() -> F,
) -> Result<T, StoreError> {
    insist_for(PAUSE, LAST_TRIES, closing, write).await
}

async fn insist_for<T, F: Future<Output = Result<T, StoreError>>>(
    pause: Duration,
    last_tries: Duration,
    closing: &Closing,
    mut write: impl FnMut() -> F,
) -> Result<T, StoreError> {
    let mut asked_to_stop = None;
    loop {
        let error = match write().await {
            Err(error) if error.is_transient() => error,
            done => return done,
        };
        if closing.is_stopping() && asked_to_stop.get_or_insert_with(Instant::now).elapsed() >= last_tries {
            return Err(error);
        }
        tokio::time::sleep(pause).await;
    }
}

#[cfg(test)]
mod tests {
    use std::future::ready;

    use super::*;

    const SHORT: Duration = Duration::from_millis(1);

    #[tokio::test]
    async fn tries_go_on_until_one_succeeds_or_fails_for_good() {
        let closing = Closing::default();
        let mut tries = 0;
        let written = insist_for(SHORT, Duration::ZERO, &closing, || {
            tries += 1;
            ready(match tries {
                1..20 => Err(StoreError::Busy),
                20..40 => Err(StoreError::DiskFull),
                _ => Ok(tries),
            })
        });
        assert_eq!(written.await.unwrap(), 40);
        let mut tries = 0;
        let refused = insist_for(SHORT, Duration::ZERO, &closing, || {
            tries += 1;
            ready(Err::<(), _>(if tries < 3 { StoreError::Busy } else { StoreError::ReadOnly }))
        });
        assert!(matches!(refused.await, Err(StoreError::ReadOnly)));
        assert_eq!(tries, 3);
    }

    #[tokio::test]
    async fn who_is_asked_to_stop_tries_for_a_while_more() {
        let (closing, mut tries, mut asked) = (Closing::default(), 0, None);
        let last_tries = Duration::from_millis(50);
        let full = insist_for(SHORT, last_tries, &closing, || {
            tries += 1;
            if tries == 20 {
                closing.stop();
                asked = Some(Instant::now());
            }
            ready(Err::<(), _>(StoreError::DiskFull))
        });
        assert!(matches!(full.await, Err(StoreError::DiskFull)));
        assert!(tries > 20 && asked.unwrap().elapsed() >= last_tries, "{tries} tries");
    }
}
