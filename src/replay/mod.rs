//! Replays the recorded candidates of a campaign through its selector, by its own rules or others. Runs no dynamics
//! and makes no labels.

mod follow;
mod overrides;
mod relocated;
mod report;
mod version;

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use orchestrator::selector::{Replay, ReplayError, SeedStructurePlan, SelectorSettings};
use serde_json::Value;
use store::Store;

use crate::campaign::{self, grader};
use crate::config::Config;
use crate::exit_status::CommandError;
use crate::output::Bar;

pub use overrides::RuleOverride;
pub use relocated::find as find_files;
pub use relocated::{ARTIFACT, MODEL, RelocatedFilesArgs, find_one};
pub use report::{FateChange, FateCounts, MissingFeatures, ReplayReport};
pub use version::{MixtureStream, mixture_of};

const BAR: &str = "{bar:32} {pos}/{len} decisions  {eta} left";

/// Replays the campaign in a store up to its current state.
pub async fn replay(
    store: &Store,
    settings: &[RuleOverride],
    moved: &RelocatedFilesArgs,
) -> Result<ReplayReport, CommandError> {
    let begun = Instant::now();
    let campaign = store.campaign().await?;
    let resolved = resolved(&campaign)?;
    let mut config = overrides::configuration(&campaign.configuration, settings)?;
    relocated::find(&mut config, &resolved, &store.grade_files().await?, moved)?;
    let mut replay = open(store, &config, settings).await?;
    let end = store.newest_mixture().await?;
    let mut report = ReplayReport::new(&campaign, settings, is_other_processor(&resolved), end.decision);
    let bar = Bar::new(Some(end.decision.unsigned_abs()), BAR);
    follow::follow(store, &config, &mut replay, &mut report, end.decision, &bar).await?;
    report.close(&replay, &end).map_err(failure)?;
    report.seconds = begun.elapsed().as_secs_f64();
    Ok(report)
}

/// The configuration with its defaults and the hashes of its files.
pub fn resolved(campaign: &store::CampaignRecord) -> Result<Value, CommandError> {
    serde_json::from_str(&campaign.resolved_configuration)
        .map_err(|error| CommandError::Failed(format!("damaged database: the configuration: {error}")))
}

/// The configuration with which the campaign began.
pub fn recorded_configuration(campaign: &store::CampaignRecord) -> Result<Config, CommandError> {
    overrides::configuration(&campaign.configuration, &[])
}

/// The settings of the selector with which the campaign began.
pub fn recorded_settings(campaign: &store::CampaignRecord) -> Result<SelectorSettings, CommandError> {
    Ok(campaign::selector_settings(&recorded_configuration(campaign)?))
}

/// The selector's state before the first decision.
async fn open(store: &Store, config: &Config, settings: &[RuleOverride]) -> Result<Replay, CommandError> {
    let (model, artifact, training) = campaign::load_for_grades(config, Path::new("(the campaign)"))?;
    let seeds = store.seed_structures().await?.into_iter();
    // The log has the conditions of walks.
    let seeds =
        seeds.map(|seed| SeedStructurePlan { name: seed.name, structure: seed.structure, walks: Vec::new() });
    let seeds = seeds.collect();
    let set = settings.iter().map(|setting| setting.rule().to_owned()).collect();
    let replay = Replay::new(
        campaign::selector_settings(config),
        set,
        seeds,
        grader(&model),
        Arc::new(artifact.mixture),
        training,
        store.imported_hashes().await?,
    );
    replay.map_err(failure)
}

/// Whether the campaign began on a processor with other instruction sets.
fn is_other_processor(resolved: &Value) -> bool {
    resolved["instructions"].as_str().is_some_and(|then| then != campaign::instructions())
}

fn failure(error: ReplayError) -> CommandError {
    CommandError::failed(error)
}
