//! A labeller as a process of its own: it says that it lives, and sees whether it is still needed.

use std::time::Duration;

use store::{ProcessRecord, Store, StoreError};

use super::{LabellerSettings, Method, Shutdown, retry_until_written, run};

/// For how long a labeller is of use when nobody leads the campaign.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExitPolicy {
    /// Until the queue is empty.
    UntilEmpty,
    /// Until every walk is over as well: somebody may lead it again.
    UntilFinished,
}

/// Labels as the process `process`, whose record it keeps; `settings.holder` is its name.
///
/// It does not need an orchestrator: while none lives, it goes on for as long as `settings.stay` says; one that starts meanwhile
/// adopts those that an earlier one started. It also goes home, after the label in hand, when another labeller of its
/// number has taken its place. `tell` gets a line for each job.
///
/// # Errors
/// Whatever the database says, also that it was deleted or replaced. Leases are given back and the record says why,
/// where that is still possible.
pub async fn serve(
    store: Store,
    method: Method,
    settings: LabellerSettings,
    process: ProcessRecord,
    shutdown: &Shutdown,
    now: impl Fn() -> i64,
    tell: impl Fn(&str),
) -> Result<(), StoreError> {
    let (interval, exit_policy) = (settings.timing.heartbeat_interval, settings.exit_policy);
    // A lease without a record of its holder would be taken back.
    retry_until_written(shutdown, || store.upsert_process(&process)).await?;
    let holder = settings.holder.clone();
    let ended = tokio::select! {
        ended = run(store.clone(), method, settings, shutdown, &now, tell) => ended,
        error = run_heartbeat(&store, process.clone(), exit_policy, shutdown, interval, &now) => Err(error),
    };
    match ended {
        Ok(()) => {
            // A lease of nobody would only come back when somebody looks for those.
            retry_until_written(shutdown, || store.state_leases(&holder, &[], now())).await?;
            retry_until_written(shutdown, || store.remove_process(&process.id)).await
        }
        Err(error) => match record_failure(&store, process, &error, now()).await {
            // Why everything else fails.
            Err(removed @ StoreError::Removed { .. }) => Err(removed),
            _ => Err(error),
        },
    }
}

/// Gives signs of life until that is impossible.
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
            // A full disk or a busy database: the next one may come through.
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
        shutdown.stop();
    }
    let led = others.iter().any(ProcessRecord::is_leading);
    let is_over = match exit_policy {
        _ if led => false,
        ExitPolicy::UntilEmpty => true,
        ExitPolicy::UntilFinished => store.all_walks_are_over().await?,
    };
    shutdown.set_no_more_jobs(is_over);
    if !led {
        // Nobody else does.
        store.release_leases_of_dead_processes(now).await?;
    }
    process.last_seen = now;
    if shutdown.is_stopping() {
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
