//! Runs a campaign with one version of the potential after the other.
//!
//! With each version, walkers and labellers are started anew; what connects the versions is in the store.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use orchestrator::reactor::RunOutcome;
use orchestrator::selector::{CampaignMode, Selector, SelectorSettings, SelectorSnapshot};
use serde_json::Value;
use store::{Store, VersionFiles, VersionRecord, unix_milliseconds};
use tokio_util::sync::CancellationToken;

use super::refit_process::RefitProcess;
use super::single_process::write_heartbeats;
use super::{RunContext, RunMode, STOP_MESSAGE, run_walks};
use crate::campaign::LoadedCampaign;
use crate::config::RefitSection;
use crate::exit_status::CommandError;
use crate::output::{count, log_and_print};
use crate::refit::schedule::RefitSchedule;
use crate::signals::cancel_on_signal;
use crate::version_updates::{read, updated_artifact};
use crate::versions::VersionOnDisk;

/// Runs the campaign until it is finished or stopped. `run` and `selector` are those of the version in force.
///
/// Await this on the main thread: processes end with the thread that starts them.
pub async fn run(
    run: RunContext<'_>,
    selector: Selector,
    mode: RunMode<'_>,
) -> Result<RunOutcome, CommandError> {
    cancel_on_signal(run.stop.clone(), STOP_MESSAGE)?;
    let Some(refit) = &run.campaign.config.refit else {
        return run_walks(run, selector, mode).await;
    };
    let mut next = run_version(run, refit, selector, mode).await?;
    loop {
        let campaign = match next {
            VersionEnd::Campaign(outcome) => return Ok(outcome),
            VersionEnd::Version(campaign) => campaign,
        };
        let run = RunContext { campaign: &campaign, ..run };
        let selector = restore_selector(&campaign, run.store).await?;
        if selector.is_done() {
            return Ok(RunOutcome::Finished);
        }
        next = run_version(run, refit, selector, mode).await?;
    }
}

/// What comes after the walks of a version.
enum VersionEnd {
    /// The campaign is finished or stopped.
    Campaign(RunOutcome),
    /// Walks with another version, or with the same one after a refit that was refused.
    Version(Box<LoadedCampaign>),
}

/// Runs the walks of one version, and the refit after them if one is due.
async fn run_version(
    run: RunContext<'_>,
    refit: &RefitSection,
    selector: Selector,
    mode: RunMode<'_>,
) -> Result<VersionEnd, CommandError> {
    let superseded = CancellationToken::new();
    let walks_end = superseded.child_token();
    let run = RunContext { superseded: &superseded, walks_end: &walks_end, ..run };
    let mut process = RefitProcess::new(run, refit);
    let ended = tokio::select! {
        ended = run_walks(run, selector, mode) => ended?,
        error = process.watch() => return Err(error),
    };
    if ended == RunOutcome::Stopped {
        process.stop().await?;
        return Ok(VersionEnd::Campaign(ended));
    }
    let schedule = RefitSchedule::read(run.store, &run.campaign.config).await?;
    let next = schedule.in_force().map_or(0, |version| version.number);
    let is_newer = next > run.campaign.version_number();
    if is_newer {
        // A version that the user went back to makes the refit beside the walks pointless.
        process.stop().await?;
    } else if process.is_running() || schedule.is_due_after_walks() {
        tokio::select! {
            ended = process.run_to_end() => ended?,
            never = write_heartbeats(run.store.clone(), run.process.clone()) => match never {},
        }
    } else {
        return Ok(VersionEnd::Campaign(ended));
    }
    if run.stop.is_cancelled() {
        return Ok(VersionEnd::Campaign(RunOutcome::Stopped));
    }
    let campaign = in_force(run.campaign, run.store, run.directory).await?;
    Ok(VersionEnd::Version(Box::new(campaign)))
}

/// The campaign with the version of the potential in force.
pub async fn in_force(
    campaign: &LoadedCampaign,
    store: &Store,
    directory: &Path,
) -> Result<LoadedCampaign, CommandError> {
    let schedule = RefitSchedule::read(store, &campaign.config).await?;
    let Some(record) = schedule.in_force().filter(|found| found.number != campaign.version_number()) else {
        return Ok(campaign.clone());
    };
    let (mut number, found) = (record.number, VersionOnDisk::find(store, record, directory).await?);
    let mut versioned = campaign.with_version(found)?;
    if campaign.config.campaign.mode == CampaignMode::Live
        && number > schedule.taken_up
        && let Some(updated) = with_updated_mixture(&versioned, store, record).await?
    {
        number = updated.number;
        versioned = campaign.with_version(VersionOnDisk::find(store, &updated, directory).await?)?;
    }
    log_and_print(format_args!("version {number} of the potential is in force"));
    Ok(versioned)
}

/// Registers the version before it is taken up once more, with its mixture updated by what walks have found since it was built. `None`
/// if nothing updates it. `campaign` is the one with this version, without walks.
///
/// A version never changes, so replay and exports find the mixture with which its walks begin in a file.
async fn with_updated_mixture(
    campaign: &LoadedCampaign,
    store: &Store,
    record: &VersionRecord,
) -> Result<Option<VersionRecord>, CommandError> {
    if record.method == VersionRecord::UPDATE {
        return Ok(None);
    }
    let (begun, path) = (Instant::now(), campaign.mixture_file()?.path);
    let load = || Ok((Arc::clone(&campaign.model), campaign.artifact.clone()));
    let updated =
        updated_artifact(store, &path, record.last_decision, load, &CancellationToken::new()).await?;
    let Some((mixture, updates)) = updated.filter(|(_, updates)| updates.applied > 0) else {
        return Ok(None);
    };
    let files = VersionFiles { model: read(&campaign.model_files()?.export.path)?, mixture };
    let versions = store.versions().await?;
    let updated = VersionRecord {
        number: versions.last().map_or(1, |last| last.number.saturating_add(1)),
        parent: record.number,
        method: VersionRecord::UPDATE.to_owned(),
        mixture_hash: blake3::hash(&files.mixture).to_string(),
        figures: figures_as_parent(&record.figures),
        seconds: begun.elapsed().as_secs_f64(),
        core_hours: 0.0,
        time: unix_milliseconds(),
        ..record.clone()
    };
    store.add_version(&updated, Some(&files)).await?;
    log_and_print(format_args!(
        "version {}: version {} with {} more in its mixture, which walks have found since it was built",
        updated.number,
        record.number,
        count(updates.applied, "structure")
    ));
    Ok(Some(updated))
}

/// The figures of a version whose parent has the same model: the errors of both are the same.
fn figures_as_parent(figures: &Value) -> Value {
    let mut figures = figures.clone();
    for set in figures.get_mut("sets").and_then(Value::as_array_mut).into_iter().flatten() {
        if let Some(set) = set.as_object_mut()
            && let Some(errors) = set.get("version").cloned()
        {
            set.insert("parent".to_owned(), errors);
        }
    }
    figures
}

/// The selector with the state in the store. New walks are started.
pub async fn restore_selector(campaign: &LoadedCampaign, store: &Store) -> Result<Selector, CommandError> {
    let snapshot = SelectorSnapshot {
        walks: store.load_walks().await?,
        components: store.load_components().await?,
        known: store.known_hashes().await?,
        imported: store.status().await?.imported,
        values: store.values().await?,
    };
    let mut selector = Selector::restore(
        SelectorSettings { refit_at: refit_at(campaign, store).await?, ..campaign.selector_settings() },
        store.campaign().await?.id,
        campaign.seed_structures.iter().map(|named| named.plan.clone()).collect(),
        campaign.grader(),
        Arc::new(campaign.artifact.mixture.clone()),
        campaign.training.clone(),
        snapshot,
    )
    .map_err(CommandError::failed)?;
    let started = selector.start_walks();
    if !started.decisions.is_empty() {
        store.commit(&started).await?;
    }
    Ok(selector)
}

/// Number of accepted structures at which walks make room for a refit. Walks of a live campaign go on beside it, until its last
/// version is there.
async fn refit_at(campaign: &LoadedCampaign, store: &Store) -> Result<Option<u32>, CommandError> {
    let config = &campaign.config;
    let Some(refit) = &config.refit else { return Ok(None) };
    let schedule = RefitSchedule::read(store, config).await?;
    if config.campaign.mode == CampaignMode::Live && !schedule.is_newest_without_walks() {
        return Ok(None);
    }
    let number = schedule.refit_at(refit);
    Ok(number.map(|number| number.min(u32::MAX.into()) as u32))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn the_same_model_has_the_errors_of_its_parent() {
        let figures =
            json!({ "sets": [{ "name": "seed", "parent": 2, "version": 1 }, "of another program"] });
        let expected =
            json!({ "sets": [{ "name": "seed", "parent": 1, "version": 1 }, "of another program"] });
        assert_eq!(figures_as_parent(&figures), expected);
        assert_eq!(figures_as_parent(&Value::Null), Value::Null);
    }
}
