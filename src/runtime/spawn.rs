//! Launches the labellers of a campaign and adopts running ones.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use orchestrator::launcher::{Children, Launch, request_exit};
use orchestrator::supervisor::Limits;
use store::{ProcessRecord, Store, StoreError};

use super::RunContext;
use super::labellers::Labellers;
use crate::exit_status::CommandError;
use crate::label_setup::LabelSetup;
use crate::process_config::{self, LabellerConfig};

/// Adopts the labellers that an earlier run left with the same configuration, and launches the missing ones.
pub async fn start_labellers(run: RunContext<'_>, limits: Limits) -> Result<Labellers, CommandError> {
    let RunContext { campaign, store, directory, .. } = run;
    let location = match &campaign.config.run.store {
        Some(url) => PathBuf::from(url),
        None => absolute(directory)?,
    };
    let label = &campaign.config.label;
    let label_setup = LabelSetup {
        method: campaign.method()?,
        protocol: campaign.protocol.clone(),
        max_attempts: label.max_attempts.get(),
        bounds: label.bounds(),
        lease_timeout: label.lease_timeout.get(),
    };
    let setup = LabellerConfig::new(location, label_setup);
    let (hash, number) = (setup.hash(), label.concurrency as u32);
    let mut labellers = Children::new(number, limits, move |number, incarnation| {
        let restarts = incarnation.saturating_sub(1);
        let setup = LabellerConfig { number: Some(number), restarts, ..setup.clone() };
        Launch::this_program(["labeller"], process_config::to_bytes(&setup)).for_own_session()
    });
    let mut adopted = BTreeMap::new();
    for found in running_labellers(store).await? {
        let wanted = found.number.filter(|_| found.setup.as_ref() == Some(&hash) && found.state == "running");
        match wanted.filter(|number| labellers.adopt(*number, found.pid, &found.start_time).is_ok()) {
            Some(number) => drop(adopted.insert(number, found.pid)),
            // Ignore a labeller that has ended meanwhile.
            None => drop(request_exit(found.pid, &found.start_time)),
        }
    }
    Ok(Labellers::new(labellers, adopted, campaign.config.label.max_attempts.get()))
}

/// Asks the labellers of an earlier run to end, because this run makes labels itself.
pub async fn stop_labellers(store: &Store) -> Result<(), CommandError> {
    for found in running_labellers(store).await? {
        let _ = request_exit(found.pid, &found.start_time);
    }
    Ok(())
}

/// Running labellers on this host that an earlier run started. Those of `calmwalk label` have no number and are left
/// alone.
async fn running_labellers(store: &Store) -> Result<Vec<ProcessRecord>, StoreError> {
    let mut labellers = store.processes(Some(ProcessRecord::LABELLER)).await?;
    labellers.retain(|found| found.number.is_some() && found.is_local() && !found.is_dead());
    Ok(labellers)
}

fn absolute(path: &Path) -> Result<PathBuf, CommandError> {
    std::path::absolute(path).map_err(CommandError::failed)
}
