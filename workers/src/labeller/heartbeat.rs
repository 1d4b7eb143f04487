//! A labeller as a process of its own: sends heartbeats and checks whether it is still needed.

use std::time::Duration;

use monitor::end_reason::is_refit_due;
use store::{ProcessRecord, Store, StoreError};

use super::{LabellerSettings, Method, Shutdown, retry_until_written, run};

/// When a labeller exits while nothing runs the campaign.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExitPolicy {
    /// When the queue is empty.
    UntilEmpty,
    /// When the queue is empty and every walk is over: the campaign may be run again before.
    UntilFinished,
}

/// Runs a labeller as the process `process` and maintains its record; `settings.holder` is its id.
///
/// It needs no orchestrator: while none is alive, it continues as `settings.exit_policy` says. An orchestrator that
/// starts later adopts labellers of earlier runs. The labeller also exits after the current label if another
/// labeller with the same number has replaced it. `on_line` receives a line for each job.
///
/// # Errors
/// Errors of the database, also if it was deleted or replaced. Releases leases and records the error if that is
/// still possible.
pub async fn serve(
    store: Store,
    method: Method,
    settings: LabellerSettings,
    process: ProcessRecord,
    shutdown: &Shutdown,
    now: impl Fn() -> i64,
    on_line: impl Fn(&str),
) -> Result<(), StoreError> {
    let (interval, exit_policy) = (settings.timing.heartbeat_interval, settings.exit_policy);
    // A lease whose holder has no record would be released.
    retry_until_written(&shutdown.stop, || store.upsert_process(&process)).await?;
    let holder = settings.holder.clone();
    let ended = tokio::select! {
        ended = run(store.clone(), method, settings, shutdown, &now, on_line) => ended,
        error = run_heartbeat(&store, process.clone(), exit_policy, shutdown, interval, &now) => Err(error),
    };
    match ended {
        Ok(()) => {
            // A lease without a holder would stay until another process looks for such leases.
            retry_until_written(&shutdown.stop, || store.state_leases(&holder, &[], now())).await?;
            retry_until_written(&shutdown.stop, || store.remove_process(&process.id)).await
        }
        Err(error) => match record_failure(&store, process, &error, now()).await {
            // This explains why everything else fails.
            Err(removed @ StoreError::Removed { .. }) => Err(removed),
            _ => Err(error),
        },
    }
}

/// Sends heartbeats until that fails for good.
async fn run_heartbeat(
    store: &Store,
    mut process: ProcessRecord,
    exit_policy: ExitPolicy,
    shutdown: &Shutdown,
    interval: Duration,
    now: impl Fn() -> i64,
) -> StoreError {
    loop {
        match send_heartbeat(store, &mut process, exit_policy, shutdown, now()).await {
            Err(error) if !error.is_transient() => return error,
            // The disk is full or the database busy: the next heartbeat may succeed.
            _ => tokio::time::sleep(interval).await,
        }
    }
}

async fn send_heartbeat(
    store: &Store,
    process: &mut ProcessRecord,
    exit_policy: ExitPolicy,
    shutdown: &Shutdown,
    now: i64,
) -> Result<(), StoreError> {
    let others = store.processes(None).await?;
    if others.iter().any(|other| other.replaces(process)) {
        shutdown.stop.cancel();
    }
    let led = others.iter().any(ProcessRecord::is_leading);
    let is_over = match exit_policy {
        _ if led => false,
        ExitPolicy::UntilEmpty => true,
        // Walks continue after a refit, which the next run makes.
        ExitPolicy::UntilFinished => store.all_walks_ended().await? && !is_refit_due(store).await?,
    };
    shutdown.set_no_more_jobs(is_over);
    if !led {
        // No other process does so.
        store.release_leases_of_dead_processes(now).await?;
    }
    process.last_seen = now;
    if shutdown.stop.is_cancelled() {
        process.state = "stopping".to_owned();
    }
    store.upsert_process(process).await
}

async fn record_failure(
    store: &Store,
    mut process: ProcessRecord,
    error: &StoreError,
    now: i64,
) -> Result<(), StoreError> {
    store.release_all(&process.id, now).await?;
    process.last_seen = now;
    process.state = "failed".to_owned();
    process.remark = error.to_string();
    store.upsert_process(&process).await
}
