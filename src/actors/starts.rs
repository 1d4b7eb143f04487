//! What the processes of a campaign are started with, and which of those that live are taken over.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use orchestrator::launcher::{Children, Launch, ask_to_end};
use orchestrator::supervisor::Limits;
use store::{ProcessRecord, Store, StoreError};
use wire::ipc::Handle;

use super::Run;
use super::labellers::Labellers;
use crate::campaign::Campaign;
use crate::labelling::Labelling;
use crate::log;
use crate::outcome::Failure;
use crate::setup::{self, LabellerSetup, WalkerSetup};

/// How walkers are started.
pub fn walker(
    campaign: &Campaign,
    line: Handle,
) -> Result<impl FnMut(u32, u32) -> Launch + Send + 'static, Failure> {
    let (model, model_hash) =
        (absolute(campaign.config.potential.model.get_ref())?, campaign.hash_of("potential.model"));
    let (parent, settings) = (std::process::id(), campaign.walk_settings());
    let precision = campaign.config.potential.precision;
    let threads = campaign.config.run.threads.get();
    Ok(move |number, incarnation| {
        line.expect(number, incarnation);
        let setup = WalkerSetup {
            parent,
            door: line.door(number, incarnation),
            model: model.clone(),
            model_hash: model_hash.clone(),
            precision,
            threads,
            settings: settings.clone(),
            log: log::for_children(),
        };
        Launch::this_program(["walker"], setup::bytes(&setup)).without_database()
    })
}

/// The labellers: those that an earlier run left and that work as this one wants it, and new ones in the other places.
pub async fn labellers(run: Run<'_>, limits: Limits) -> Result<Labellers, Failure> {
    let Run { campaign, store, directory, .. } = run;
    let location = match &campaign.config.run.store {
        Some(url) => PathBuf::from(url),
        None => absolute(directory)?,
    };
    let label = &campaign.config.label;
    let labelling = Labelling {
        method: campaign.method()?,
        protocol: campaign.protocol.clone(),
        attempts: label.attempts.get(),
        bounds: label.bounds(),
        lease: label.lease.get(),
    };
    let setup = LabellerSetup::new(location, labelling);
    let (hash, slots) = (setup.hash(), label.slots as u32);
    let mut labellers = Children::new(slots, limits, move |number, incarnation| {
        let restarts = incarnation.saturating_sub(1);
        let setup = LabellerSetup { number: Some(number), restarts, ..setup.clone() };
        Launch::this_program(["labeller"], setup::bytes(&setup)).for_own_session()
    });
    let mut adopted = BTreeMap::new();
    for found in left_by_runs(store).await? {
        let wanted = found.number.filter(|_| found.setup.as_ref() == Some(&hash) && found.state == "running");
        match wanted.filter(|number| labellers.adopt(*number, found.pid, &found.birth).is_ok()) {
            Some(number) => drop(adopted.insert(number, found.pid)),
            // One that ended meanwhile needs no asking.
            None => drop(ask_to_end(found.pid, &found.birth)),
        }
    }
    Ok(Labellers::new(labellers, adopted, campaign.config.label.attempts.get()))
}

/// Asks the labellers that an earlier run left to end: this run makes its labels itself.
pub async fn no_labellers(store: &Store) -> Result<(), Failure> {
    for found in left_by_runs(store).await? {
        let _ = ask_to_end(found.pid, &found.birth);
    }
    Ok(())
}

/// The labellers here that an earlier run started. Those of `calmwalk label` have no number, and are their own masters.
async fn left_by_runs(store: &Store) -> Result<Vec<ProcessRecord>, StoreError> {
    let mut labellers = store.processes(Some(ProcessRecord::LABELLER)).await?;
    labellers.retain(|found| found.number.is_some() && found.is_local() && !found.is_gone());
    Ok(labellers)
}

fn absolute(path: &Path) -> Result<PathBuf, Failure> {
    std::path::absolute(path).map_err(Failure::failed)
}
