//! `calmwalk labeller`

use std::time::Duration;

use orchestrator::launcher;
use store::{Location, ProcessRecord, Store, unix_milliseconds};
use tokio::signal::unix::{SignalKind, signal};
use workers::labeller::{ExitPolicy, LabellerSettings, Method, Shutdown, Timing, retry_until_written, serve};

use super::{CommandError, ExitStatus, block_on};
use crate::log;
use crate::output::print_stderr;
use crate::process_config::{self, LabellerConfig};

/// Internal: a labeller process, started by `calmwalk run` and `calmwalk label`
///
/// Reads its settings from standard input. If the `calmwalk run` that started it is killed, it continues until the queue is empty or the
/// next run takes it over; if `calmwalk label` is killed, it exits. On SIGTERM it exits after the current label. If a calculation of an
/// external program needs more than a few seconds, it leaves the running calculation to the next labeller.
#[derive(Debug, clap::Args)]
pub struct LabellerArgs {}

impl LabellerArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        launcher::set_process_name(c"calmwalk").map_err(CommandError::failed)?;
        let setup: LabellerConfig = process_config::from_stdin()?;
        log::init(setup.log.clone(), "labeller", setup.number)?;
        match &setup.pool {
            Some(pool) => launcher::end_with_parent(pool.parent).map_err(CommandError::failed)?,
            None => launcher::start_own_session().map_err(CommandError::failed)?,
        }
        let method = setup.method.load(&setup.protocol)?;
        let closing = Shutdown::default();
        block_on(label(setup, method, &closing))??;
        Ok(if closing.stop.is_cancelled() { ExitStatus::Interrupted } else { ExitStatus::Done })
    }
}

async fn label(setup: LabellerConfig, method: Method, closing: &Shutdown) -> Result<(), CommandError> {
    let (mut terminate, stop) =
        (signal(SignalKind::terminate()).map_err(CommandError::failed)?, closing.stop.clone());
    tokio::spawn(async move {
        terminate.recv().await;
        stop.cancel();
    });
    let location: Location =
        setup.location.to_str().map_or_else(|| Ok(Location::from(&setup.location)), str::parse)?;
    let store = retry_until_written(&closing.stop, || Store::open(&location)).await?;
    let (pid, now) = (std::process::id(), unix_milliseconds());
    let record = ProcessRecord::new(ProcessRecord::LABELLER, setup.number, pid, now);
    // Only labellers of `calmwalk run` are taken over by the next run.
    let hash = setup.pool.is_none().then(|| setup.hash());
    let record = ProcessRecord { setup: hash, restarts: setup.restarts, ..record };
    let pool = setup.pool.as_ref();
    let settings = LabellerSettings {
        holder: record.id.clone(),
        protocol: setup.protocol,
        attempts: setup.max_attempts,
        bounds: setup.bounds,
        exit_policy: if pool.is_none_or(|pool| pool.until_empty) {
            ExitPolicy::UntilEmpty
        } else {
            ExitPolicy::UntilFinished
        },
        timing: Timing {
            lease: setup.lease_timeout,
            grace: pool.map(|pool| Duration::from_secs_f64(pool.grace_period)),
            ..Timing::default()
        },
    };
    let reports = pool.is_some();
    let report = |line: &str| {
        if reports {
            print_stderr(line);
        }
    };
    serve(store.clone(), method, settings, record, closing, unix_milliseconds, report).await?;
    store.close().await;
    Ok(())
}
