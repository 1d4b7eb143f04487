//! Keeps count of the time that a campaign is under way, and stops it when a limit of time is reached.

use std::time::Duration;

use store::{Budget, Store, StoreError, unix_milliseconds};
use tokio::sync::Notify;
use tokio::time::{Instant, MissedTickBehavior, interval};

use crate::output::log_and_print;

/// Between two looks.
const POLL_INTERVAL: Duration = Duration::from_secs(1);

/// The limit of time that is reached.
pub async fn exhausted_time_limit(store: &Store) -> Result<Option<&'static str>, StoreError> {
    let (limits, used) = store.budget(unix_milliseconds()).await?;
    Ok(limits.time_used_up(&used))
}

/// Counts the time until it is dropped, and says so to `limit_reached` when a limit is reached: once, as somebody who asks to stop.
/// A database that is busy is told later.
pub async fn track(store: &Store, limits: &Budget, limit_reached: &Notify) -> StoreError {
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
                    limit_reached.notify_one();
                }
            }
            Err(error) if error.is_transient() => {}
            Err(error) => return error,
        }
    }
}

/// Adds the time, and looks whether a limit is reached if there is one.
async fn add_time(store: &Store, time: Duration, limited: bool) -> Result<Option<&'static str>, StoreError> {
    store.add_time_under_way(time.as_millis() as u64).await?;
    if limited { exhausted_time_limit(store).await } else { Ok(None) }
}
