//! Keeps count of the time that a campaign is under way, and stops it when a limit of time is reached.

use std::time::Duration;

use store::{Budget, Store, StoreError, unix_milliseconds};
use tokio::sync::Notify;
use tokio::time::{Instant, MissedTickBehavior, interval};

use crate::output::say;

/// Between two looks.
const LOOK: Duration = Duration::from_secs(1);

/// The limit of time that is reached.
pub async fn time_used_up(store: &Store) -> Result<Option<&'static str>, StoreError> {
    let (limits, used) = store.budget(unix_milliseconds()).await?;
    Ok(limits.time_used_up(&used))
}

/// Counts the time until it is dropped, and says so to `over` when a limit is reached: once, as somebody who asks to stop.
/// A database that is busy is told later.
pub async fn keep(store: &Store, limits: &Budget, over: &Notify) -> StoreError {
    let limited = limits.wall_hours.is_some() || limits.core_hours.is_some();
    let mut look = interval(LOOK);
    look.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let (mut counted, mut is_over) = (Instant::now(), false);
    loop {
        look.tick().await;
        let now = Instant::now();
        match count(store, now - counted, limited).await {
            Ok(used_up) => {
                counted = now;
                if let Some(key) = used_up.filter(|_| !is_over) {
                    say(format_args!("{key} is used up"));
                    is_over = true;
                    over.notify_one();
                }
            }
            Err(error) if error.is_transient() => {}
            Err(error) => return error,
        }
    }
}

/// Adds the time, and looks whether a limit is reached if there is one.
async fn count(store: &Store, time: Duration, limited: bool) -> Result<Option<&'static str>, StoreError> {
    store.add_running_time(time.as_millis() as u64).await?;
    if limited { time_used_up(store).await } else { Ok(None) }
}
