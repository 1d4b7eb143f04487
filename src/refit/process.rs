//! A refit in this process, with a record in the database that says where it is.

use std::convert::Infallible;
use std::sync::{Arc, Mutex, PoisonError};

use store::{Location, ProcessRecord, Store, unix_milliseconds};
use tokio::time::{MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;
use workers::labeller::HEARTBEAT_INTERVAL;

use super::RefitOutcome;
use super::settings::RefitterConfig;
use crate::exit_status::CommandError;
use crate::output::print_stderr;

/// Runs a refit, or continues the one that was interrupted. Prints the progress to standard error.
///
/// # Errors
/// Those of [`super::run`].
pub async fn run(config: &RefitterConfig, stop: &CancellationToken) -> Result<RefitOutcome, CommandError> {
    let location: Location =
        config.location.to_str().map_or_else(|| Ok(Location::from(&config.location)), str::parse)?;
    let store = Store::open(&location).await?;
    let line = Arc::new(Mutex::new(String::new()));
    let record = ProcessRecord::new(ProcessRecord::REFITTER, None, std::process::id(), unix_milliseconds());
    // A task of its own: the steps of a refit block this one.
    let heartbeats = tokio::spawn(write_heartbeats(store.clone(), record.clone(), Arc::clone(&line)));
    let report = |text: String| {
        print_stderr(&text);
        *line.lock().unwrap_or_else(PoisonError::into_inner) = text;
    };
    let ended = super::run(config, &store, stop, &report).await;
    heartbeats.abort();
    // The orchestrator removes the record of a process that is gone.
    let _ = store.remove_process(&record.id).await;
    store.close().await;
    ended
}

async fn write_heartbeats(store: Store, mut record: ProcessRecord, line: Arc<Mutex<String>>) -> Infallible {
    let mut ticks = interval(HEARTBEAT_INTERVAL);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        record.last_seen = unix_milliseconds();
        record.remark.clone_from(&line.lock().unwrap_or_else(PoisonError::into_inner));
        // A busy database may miss a heartbeat.
        if let Err(error) = store.upsert_process(&record).await {
            tracing::warn!("cannot record the heartbeat: {error}");
        }
    }
}
