//! `calmwalk labeller`

use std::sync::Arc;
use std::time::Duration;

use orchestrator::launcher;
use store::{Location, ProcessRecord, Store, unix_milliseconds};
use tokio::signal::unix::{SignalKind, signal};
use workers::labeller::{Closing, LabellerSettings, Method, Stay, Timing, insist, serve};

use super::{Ended, Failure, block_on};
use crate::log;
use crate::output::show;
use crate::setup::{self, LabellerSetup};

/// A labeller's process; `calmwalk run` and `calmwalk label` start it
///
/// It reads what to do from standard input. If the run that started it is killed it goes on until the queue is empty, or
/// until the next run takes it over; with `calmwalk label` it ends. SIGTERM ends it after the label in hand;
/// a calculation of another program that takes longer than some seconds goes on and is left to the next labeller.
#[derive(Debug, clap::Args)]
pub struct Labeller {}

impl Labeller {
    pub fn run(self) -> Result<Ended, Failure> {
        launcher::set_process_name(c"calmwalk").map_err(Failure::failed)?;
        let setup: LabellerSetup = setup::read()?;
        log::begin(setup.log.clone(), "labeller", setup.number)?;
        match &setup.slot {
            Some(slot) => launcher::end_with_parent(slot.parent).map_err(Failure::failed)?,
            None => launcher::start_own_session().map_err(Failure::failed)?,
        }
        let method = setup.method.load(&setup.protocol)?;
        let closing = Arc::new(Closing::default());
        block_on(label(setup, method, &closing))??;
        Ok(if closing.is_stopping() { Ended::Interrupted } else { Ended::Done })
    }
}

async fn label(setup: LabellerSetup, method: Method, closing: &Arc<Closing>) -> Result<(), Failure> {
    let (mut terminate, asked) =
        (signal(SignalKind::terminate()).map_err(Failure::failed)?, Arc::clone(closing));
    tokio::spawn(async move {
        while terminate.recv().await.is_some() {
            asked.stop();
        }
    });
    let location: Location =
        setup.location.to_str().map_or_else(|| Ok(Location::from(&setup.location)), str::parse)?;
    let store = insist(closing, || Store::open(&location)).await?;
    let (pid, now) = (std::process::id(), unix_milliseconds());
    let record = ProcessRecord::new(ProcessRecord::LABELLER, setup.number, pid, now);
    // Nobody adopts a slot.
    let hash = setup.slot.is_none().then(|| setup.hash());
    let record = ProcessRecord { setup: hash, restarts: setup.restarts, ..record };
    let slot = setup.slot.as_ref();
    let settings = LabellerSettings {
        holder: record.id.clone(),
        protocol: setup.protocol,
        attempts: setup.attempts,
        bounds: setup.bounds,
        stay: if slot.is_none_or(|slot| slot.until_empty) { Stay::UntilEmpty } else { Stay::UntilFinished },
        timing: Timing {
            lease: setup.lease,
            grace: slot.map(|slot| Duration::from_secs_f64(slot.grace)),
            ..Timing::default()
        },
    };
    let tells = slot.is_some();
    let tell = |line: &str| {
        if tells {
            show(line);
        }
    };
    serve(store.clone(), method, settings, record, closing, unix_milliseconds, tell).await?;
    store.close().await;
    Ok(())
}
