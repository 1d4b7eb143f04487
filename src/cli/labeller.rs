//! `calmwalk labeller`

use std::sync::Arc;
use std::sync::atomic::Ordering;

use orchestrator::launcher;
use store::{Location, ProcessRecord, Store, unix_milliseconds};
use tokio::signal::unix::{SignalKind, signal};
use workers::labeller::{Closing, LabellerSettings, ReferenceMethod, Timing, serve};

use super::{Ended, Failure, block_on};
use crate::setup::{self, LabellerSetup, unchanged};

/// A labeller's process; `calmwalk run` starts it
///
/// It reads what to do from standard input. If the run that started it is killed it goes on until the queue is empty, or
/// until the next run takes it over. SIGTERM ends it after the label in hand.
#[derive(Debug, clap::Args)]
pub struct Labeller {}

impl Labeller {
    pub fn run(self) -> Result<Ended, Failure> {
        launcher::be_called(c"calmwalk").map_err(Failure::failed)?;
        launcher::own_session().map_err(Failure::failed)?;
        let setup: LabellerSetup = setup::read()?;
        unchanged(&setup.file, &setup.file_hash)?;
        let method = ReferenceMethod::new(setup.kind.load(&setup.file).map_err(Failure::Input)?);
        let closing = Arc::new(Closing::default());
        block_on(label(setup, method, &closing))??;
        Ok(if closing.stopping.load(Ordering::Relaxed) { Ended::Interrupted } else { Ended::Done })
    }
}

async fn label(setup: LabellerSetup, method: ReferenceMethod, closing: &Arc<Closing>) -> Result<(), Failure> {
    let (mut terminate, asked) =
        (signal(SignalKind::terminate()).map_err(Failure::failed)?, Arc::clone(closing));
    tokio::spawn(async move {
        while terminate.recv().await.is_some() {
            asked.stopping.store(true, Ordering::Relaxed);
        }
    });
    let store = match &setup.store {
        Some(url) => Store::open(url.parse::<Location>()?).await?,
        None => Store::open(&setup.directory).await?,
    };
    let record = ProcessRecord::new(
        ProcessRecord::LABELLER,
        Some(setup.number),
        std::process::id(),
        unix_milliseconds(),
    );
    let record = ProcessRecord { setup: Some(setup.hash()), restarts: setup.restarts, ..record };
    let settings = LabellerSettings {
        holder: record.id.clone(),
        protocol: setup.protocol,
        attempts: setup.attempts,
        largest_force: setup.largest_force,
        timing: Timing::default(),
    };
    serve(store.clone(), method, settings, record, closing, unix_milliseconds).await?;
    store.close().await;
    Ok(())
}
