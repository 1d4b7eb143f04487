//! Runs a campaign with one version of the potential after the other.
//!
//! With each version, walkers and labellers are started anew; what connects the versions is in the store.

use std::path::Path;
use std::sync::Arc;

use monitor::refit_schedule::AfterWalks;
use orchestrator::reactor::RunOutcome;
use orchestrator::selector::{Selector, SelectorSettings, SelectorSnapshot};
use store::{Store, WalkRecord, unix_milliseconds};
use tokio_util::sync::CancellationToken;
use workers::walk::has_known_layout;

use super::refit_process::RefitProcess;
use super::single_process::write_heartbeats;
use super::{RunContext, RunMode, STOP_MESSAGE, run_walks};
use crate::campaign::LoadedCampaign;
use crate::config::RefitSection;
use crate::exit_status::CommandError;
use crate::output::{count, log_and_print};
use crate::refit::schedule;
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
    let schedule = schedule::read(store, &campaign.config).await?;
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
    let schedule = schedule::read(run.store, &run.campaign.config).await?;
    match schedule.after_walks(run.campaign.version_number(), process.is_running()) {
        AfterWalks::NewerVersion => process.stop().await?,
        AfterWalks::Refit => tokio::select! {
            ended = process.run_to_end() => ended?,
            never = write_heartbeats(run.store.clone(), run.process.clone()) => match never {},
        },
        AfterWalks::End => return Ok(VersionEnd::Campaign(ended)),
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
    let schedule = schedule::read(store, &campaign.config).await?;
    let Some(record) = schedule.in_force().filter(|found| found.number != campaign.version_number()) else {
        return Ok(campaign.clone());
    };
    let found = VersionOnDisk::find(store, record, directory).await?;
    log_and_print(format_args!("version {} of the potential is in force", record.number));
    Ok(campaign.with_version(found)?)
}

/// The selector with the state in the store. New walks are started.
pub async fn restore_selector(campaign: &LoadedCampaign, store: &Store) -> Result<Selector, CommandError> {
    let walks = store.load_walks().await?;
    check_layout(&walks)?;
    let snapshot = SelectorSnapshot {
        walks,
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
    // Those that continue because a limit was raised, or a version refused.
    check_layout(&started.walks)?;
    if !started.decisions.is_empty() {
        store.commit(&started).await?;
    }
    Ok(selector)
}

/// Refuses walks that another version of calmwalk began and that have steps to make.
fn check_layout(walks: &[WalkRecord]) -> Result<(), CommandError> {
    let is_foreign = |walk: &&WalkRecord| {
        walk.is_active() && walk.checkpoint.as_ref().is_some_and(|checkpoint| !has_known_layout(checkpoint))
    };
    let foreign: Vec<_> = walks.iter().filter(is_foreign).collect();
    match foreign.first() {
        None => Ok(()),
        Some(first) => Err(CommandError::Input(format!(
            "another version of calmwalk began {} of this campaign (the first is walk {}), and this version cannot read their checkpoints: \
             start another campaign; `calmwalk import` takes over what is labelled",
            count(foreign.len() as u64, "walk"),
            first.walk.0
        ))),
    }
}

/// Number of accepted structures at which walks make room for a refit.
async fn refit_at(campaign: &LoadedCampaign, store: &Store) -> Result<Option<u32>, CommandError> {
    match campaign.config.refit {
        Some(_) => Ok(schedule::read(store, &campaign.config).await?.walks_end_at()),
        None => Ok(None),
    }
}

#[cfg(test)]
mod tests {
    use wire::messages::WalkProgress;
    use wire::{Origin, WalkConditions, WalkId};

    use super::*;

    #[test]
    fn walks_of_another_version_of_calmwalk_are_refused_while_they_have_steps_to_make() {
        let walk = |state: &str, checkpoint: Option<&[u8]>| WalkRecord {
            walk: WalkId(3),
            origin: Origin::Biased,
            partner: None,
            seed_structure: 0,
            conditions: WalkConditions::default(),
            state: state.into(),
            reason: String::new(),
            assignments: 1,
            accepted: 0,
            progress: WalkProgress::default(),
            selector_state: String::new(),
            checkpoint: checkpoint.map(<[u8]>::to_vec),
        };
        let fine = [walk("waiting", None), walk("completed", Some(b"older"))];
        assert!(check_layout(&fine).is_ok());
        let Err(CommandError::Input(message)) = check_layout(&[walk("running", Some(b"older"))]) else {
            panic!("accepted")
        };
        assert!(message.contains("began 1 walk of this campaign (the first is walk 3)"), "{message}");
    }
}
