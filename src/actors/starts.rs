//! What the processes of a campaign are started with, and which of those that live are taken over.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use orchestrator::launcher::{Children, Launch, ask_to_end};
use orchestrator::supervisor::Limits;
use store::{ProcessRecord, Store};
use wire::ipc::Handle;

use super::Run;
use super::labellers::Labellers;
use crate::campaign::Campaign;
use crate::config::LabelMethod;
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
    Ok(move |number, incarnation| {
        line.expect(number, incarnation);
        let setup = WalkerSetup {
            parent,
            door: line.door(number, incarnation),
            model: model.clone(),
            model_hash: model_hash.clone(),
            settings: settings.clone(),
        };
        Launch::this_program(["walker"], setup::bytes(&setup))
    })
}

/// The labellers: those that an earlier run left and that work as this one wants it, and new ones in the other places.
pub async fn labellers(run: Run<'_>, limits: Limits) -> Result<Labellers, Failure> {
    let Run { campaign, store, directory, .. } = run;
    let LabelMethod::Reference(potential) = &campaign.config.label.method;
    let setup = LabellerSetup {
        number: 0,
        restarts: 0,
        directory: absolute(directory)?,
        store: campaign.config.run.store.clone(),
        kind: potential.kind,
        file: absolute(potential.file.get_ref())?,
        file_hash: campaign.hash_of("label.method.reference.file"),
        protocol: campaign.protocol.clone(),
        attempts: campaign.config.label.attempts.get(),
        largest_force: campaign.config.label.largest_force.get(),
    };
    let hash = setup.hash();
    let slots = campaign.config.label.slots.get() as u32;
    let mut labellers = Children::new(slots, limits, move |number, incarnation| {
        let setup = LabellerSetup { number, restarts: incarnation.saturating_sub(1), ..setup.clone() };
        Launch::this_program(["labeller"], setup::bytes(&setup)).for_own_session()
    });
    let mut adopted = BTreeMap::new();
    for found in store.processes(Some(ProcessRecord::LABELLER)).await? {
        if !found.is_local() || found.is_gone() {
            continue;
        }
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
    for found in store.processes(Some(ProcessRecord::LABELLER)).await? {
        if found.is_local() && !found.is_gone() {
            let _ = ask_to_end(found.pid, &found.birth);
        }
    }
    Ok(())
}

fn absolute(path: &Path) -> Result<PathBuf, Failure> {
    std::path::absolute(path).map_err(Failure::failed)
}
