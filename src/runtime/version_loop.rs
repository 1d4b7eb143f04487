//! Runs a campaign with one version of the potential after the other.
//!
//! With each version, walkers and labellers are started anew; what connects the versions is in the store.

use std::path::Path;
use std::sync::Arc;

use orchestrator::reactor::RunOutcome;
use orchestrator::selector::{CampaignMode, Selector, SelectorSettings, SelectorSnapshot};
use store::{Store, unix_milliseconds};
use tokio_util::sync::CancellationToken;

use super::refit_process::RefitProcess;
use super::single_process::write_heartbeats;
use super::{RunContext, RunMode, STOP_MESSAGE, run_walks};
use crate::campaign::LoadedCampaign;
use crate::config::RefitSection;
use crate::exit_status::CommandError;
use crate::output::log_and_print;
use crate::refit::schedule::RefitSchedule;
use crate::signals::cancel_on_signal;
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
        if selector.is_done() && !is_anything_left(&campaign, run.store).await? {
            return Ok(RunOutcome::Finished);
        }
        next = run_version(run, refit, selector, mode).await?;
    }
}

/// Whether a campaign whose walks have all ended has labels to wait for, or a version to train. Walks that made room for a version
/// did not wait for theirs.
async fn is_anything_left(campaign: &LoadedCampaign, store: &Store) -> Result<bool, CommandError> {
    let schedule = RefitSchedule::read(store, &campaign.config).await?;
    Ok(schedule.progress.is_refit_left() || store.has_pending_labels(unix_milliseconds()).await?)
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
    } else if process.is_running() || schedule.progress.is_refit_left() {
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
    let found = VersionOnDisk::find(store, record, directory).await?;
    log_and_print(format_args!("version {} of the potential is in force", record.number));
    Ok(campaign.with_version(found)?)
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

/// Number of accepted structures at which walks make room for a refit. Walks of a live campaign continue beside it, until its last
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
