//! Counts how long a campaign has been running and stops it at a time limit.

use std::time::Duration;

use store::{Budget, Store, StoreError, unix_milliseconds};
use tokio::time::{Instant, MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;

use crate::output::log_and_print;

/// Interval between updates of the count.
const POLL_INTERVAL: Duration = Duration::from_secs(1);

/// The key of the time limit that is exhausted, if any.
pub async fn exhausted_time_limit(store: &Store) -> Result<Option<&'static str>, StoreError> {
    let (limits, used) = store.budget(unix_milliseconds()).await?;
    Ok(limits.time_used_up(&used))
}

/// Counts the time until the future is dropped. Cancels `stop` when a limit is reached, which stops the run in order.
/// Retries while the database is busy.
pub async fn track(store: &Store, limits: &Budget, stop: &CancellationToken) -> StoreError {
    let limited = limits.wall_hours.is_some() || limits.core_hours.is_some();
    let mut ticks = interval(POLL_INTERVAL);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let (mut counted, mut reported) = (Instant::now(), false);
    loop {
        ticks.tick().await;
        let now = Instant::now();
        match add_time(store, now - counted, limited).await {
            Ok(used_up) => {
                counted = now;
                if let Some(key) = used_up.filter(|_| !reported) {
                    log_and_print(format_args!("{key} is used up"));
                    reported = true;
                    stop.cancel();
                }
            }
            Err(error) if error.is_transient() => {}
            Err(error) => return error,
        }
    }
}

/// Adds to the count. Checks the limits if there are any.
async fn add_time(store: &Store, time: Duration, limited: bool) -> Result<Option<&'static str>, StoreError> {
    store.add_running_time(time.as_millis() as u64).await?;
    if limited { exhausted_time_limit(store).await } else { Ok(None) }
}
