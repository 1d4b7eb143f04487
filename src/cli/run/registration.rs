//! The record of the process that runs a campaign: from its start to its end, unless it is killed.

use std::time::Duration;

use orchestrator::reactor::RunOutcome;
use serde_json::{Value, json};
use store::{ProcessRecord, SERVER_RECONNECT_TIMEOUT, Store, StoreError, unix_milliseconds};

use crate::exit_status::CommandError;

/// How long a run that has failed tries to record its end: the database may be the reason.
const FAILURE_TIMEOUT: Duration = Duration::from_secs(10);

/// Registers this process, and reclaims the leases of dead ones. The caller holds the lock, so there is no other orchestrator.
pub async fn register(store: &Store) -> Result<ProcessRecord, StoreError> {
    let now = unix_milliseconds();
    store.reclaim_leases(now).await?;
    let record = ProcessRecord::new(ProcessRecord::ORCHESTRATOR, None, std::process::id(), now);
    store.upsert_process(&record).await?;
    let detail = json!({ "process": record.id, "program_version": env!("CARGO_PKG_VERSION") });
    store.log_operation(now, "started", &detail).await?;
    Ok(record)
}

/// Releases what this process holds, removes its registration and records how it ended. Returns the store, which from then on
/// reconnects to its server.
///
/// # Errors
/// The database, unless the run has failed: then that is what the user has to know.
pub async fn unregister(
    store: Store,
    process: &ProcessRecord,
    worked: Result<&RunOutcome, &CommandError>,
) -> Result<Store, StoreError> {
    let how = match worked {
        Ok(RunOutcome::Finished) => json!({ "process": process.id, "how": "done" }),
        Ok(RunOutcome::Stopped) => json!({ "process": process.id, "how": "stopped" }),
        Err(failure) => {
            let how = json!({ "process": process.id, "how": "failed", "error": failure.to_string() });
            match tokio::time::timeout(FAILURE_TIMEOUT, record_end(&store, process, &how)).await {
                Ok(Ok(())) => {}
                Ok(Err(error)) => tracing::warn!("cannot record the end of this process: {error}"),
                Err(_) => {
                    tracing::warn!("cannot record the end of this process: the database does not answer")
                }
            }
            return Ok(store);
        }
    };
    // Do not fail after hours of work because the server is unreachable in the last second.
    let store = store.with_reconnect_timeout(SERVER_RECONNECT_TIMEOUT);
    loop {
        match record_end(&store, process, &how).await {
            Err(StoreError::Unreachable(_)) => {}
            result => return result.map(|()| store),
        }
    }
}

async fn record_end(store: &Store, process: &ProcessRecord, how: &Value) -> Result<(), StoreError> {
    let now = unix_milliseconds();
    store.release_all(&process.id, now).await?;
    store.remove_process(&process.id).await?;
    store.log_operation(now, "ended", how).await
}
