//! What a run does for those who watch it: samples of the campaign for its history, and the line about labels under way.

use std::convert::Infallible;
use std::time::Duration;

use monitor::label_cost::CostEstimator;
use monitor::label_progress;
use store::{Store, StoreError, unix_milliseconds};
use tokio::time::{MissedTickBehavior, interval};

use crate::label_line::LabelLine;
use crate::wording;

/// Interval between samples.
const SAMPLE_INTERVAL: Duration = Duration::from_secs(5);
/// Number of samples after which those that have aged are thinned out, and the costs of labels read again.
const SAMPLES_UNTIL_THINNED: u32 = 12;

/// Records samples of the run that began at `run` (ms since 1970) and shows labels under way, for ever. Ignores errors: other parts of the
/// run report a broken database.
pub async fn watch(store: &Store, run: i64, line: &LabelLine) -> Infallible {
    let mut ticks = interval(SAMPLE_INTERVAL);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let (mut number, mut costs) = (0_u32, None);
    loop {
        ticks.tick().await;
        let now = unix_milliseconds();
        let _ = store.add_history_sample(run, now).await;
        if number.is_multiple_of(SAMPLES_UNTIL_THINNED) {
            let _ = store.thin_history(now).await;
            costs = estimator(store).await.ok().flatten();
        }
        number += 1;
        if let Some(costs) = &costs
            && let Ok(text) = labels(store, costs, now).await
        {
            line.show(&text);
        }
    }
}

async fn estimator(store: &Store) -> Result<Option<CostEstimator>, StoreError> {
    match store.protocol_in_force().await? {
        Some(protocol) => Ok(Some(CostEstimator::from_store(store, protocol.hash).await?)),
        None => Ok(None),
    }
}

/// The line about labels; empty while none is being made.
async fn labels(store: &Store, costs: &CostEstimator, now: i64) -> Result<String, StoreError> {
    let running = label_progress::read(store, costs).await?;
    if running.is_empty() {
        return Ok(String::new());
    }
    let jobs = store.jobs_by_protocol().await?;
    Ok(wording::label_progress::line(&running, &jobs, now))
}
