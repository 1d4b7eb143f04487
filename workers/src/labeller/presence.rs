//! A labeller as a process of its own: it says that it lives, and sees whether it is still needed.

use std::time::Duration;

use store::{ProcessRecord, Store, StoreError};

use super::{Closing, LabellerSettings, Method, insist, run};

/// For how long a labeller is of use when nobody leads the campaign.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stay {
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
    closing: &Closing,
    now: impl Fn() -> i64,
    tell: impl Fn(&str),
) -> Result<(), StoreError> {
    let (every, stay) = (settings.timing.sign_of_life, settings.stay);
    // A lease without a record of its holder would be taken back.
    insist(closing, || store.upsert_process(&process)).await?;
    let holder = settings.holder.clone();
    let ended = tokio::select! {
        ended = run(store.clone(), method, settings, closing, &now, tell) => ended,
        error = live(&store, process.clone(), stay, closing, every, &now) => Err(error),
    };
    match ended {
        Ok(()) => {
            // A lease of nobody would only come back when somebody looks for those.
            insist(closing, || store.state_leases(&holder, &[], now())).await?;
            insist(closing, || store.remove_process(&process.id)).await
        }
        Err(error) => match fail(&store, process, &error, now()).await {
            // Why everything else fails.
            Err(removed @ StoreError::Removed { .. }) => Err(removed),
            _ => Err(error),
        },
    }
}

/// Gives signs of life until that is impossible.
async fn live(
    store: &Store,
    mut process: ProcessRecord,
    stay: Stay,
    closing: &Closing,
    every: Duration,
    now: impl Fn() -> i64,
) -> StoreError {
    loop {
        match sign_of_life(store, &mut process, stay, closing, now()).await {
            Err(error) if !error.is_transient() => return error,
            // A full disk or a busy database: the next one may come through.
            _ => tokio::time::sleep(every).await,
        }
    }
}

async fn sign_of_life(
    store: &Store,
    process: &mut ProcessRecord,
    stay: Stay,
    closing: &Closing,
    now: i64,
) -> Result<(), StoreError> {
    let others = store.processes(None).await?;
    if others.iter().any(|other| other.replaces(process)) {
        closing.stop();
    }
    let led = others.iter().any(ProcessRecord::is_leading);
    let is_over = match stay {
        _ if led => false,
        Stay::UntilEmpty => true,
        Stay::UntilFinished => store.all_walks_are_over().await?,
    };
    closing.set_no_more_jobs(is_over);
    if !led {
        // Nobody else does.
        store.release_leases_of_gone_processes(now).await?;
    }
    process.last_seen = now;
    if closing.is_stopping() {
        process.state = "stopping".to_owned();
    }
    store.upsert_process(process).await
}

async fn fail(
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
