//! The start of a run: checks that the campaign belongs to the configuration, and reports where it resumes.

use std::path::Path;

use monitor::end_reason::CampaignEnd;
use monitor::provenance::{self, ConfigMatch, Provenance};
use serde_json::Value;
use store::{Location, Store, unix_milliseconds};

use crate::campaign::LoadedCampaign;
use crate::config::{self, ConfigChange, Refused, compare};
use crate::exit_status::CommandError;
use crate::output::{count, log_and_print};

/// Records the configuration of a new campaign.
pub async fn record_start(
    store: &Store,
    origin: &Provenance,
    location: &Location,
) -> Result<(), CommandError> {
    record(store, origin).await?;
    log_and_print(format_args!(
        "starting campaign '{}' in {location} with {}",
        origin.name, origin.file.path
    ));
    Ok(())
}

/// Checks that the campaign in the store belongs to this configuration, and applies the permitted changes of the configuration.
pub async fn resume(
    campaign: &LoadedCampaign,
    store: &Store,
    location: &Location,
    origin: &Provenance,
    adopt: bool,
) -> Result<(), CommandError> {
    let known = Provenance::read(store).await?;
    let has_campaign = matches!(location, Location::Directory(_));
    let matched = known.as_ref().map(|known| known.compare(origin, has_campaign, Path::exists));
    let other = known.as_ref().filter(|_| matched == Some(ConfigMatch::Other));
    let resolved = campaign.resolved();
    let changes = compare(&in_force(store).await?, &resolved)
        .map_err(|refused| changed_content(campaign, location, other, &refused))?;
    match other {
        Some(known) if !adopt => return Err(other_file(campaign, location, known)),
        Some(known) => {
            log_and_print(format_args!("configuration: {} replaces {}", origin.file.path, known.file.path))
        }
        None => {}
    }
    record(store, &known.map_or_else(|| origin.clone(), |known| known.continued(origin))).await?;
    report_progress(store, origin, location).await?;
    if changes.is_empty() {
        return Ok(());
    }
    changes.iter().for_each(|change| log_and_print(format_args!("configuration: {change}")));
    store.add_seed_structures(&campaign.stored_seed_structures()).await?;
    let details: Vec<_> = changes.iter().map(ConfigChange::detail).collect();
    Ok(store.set_configuration_in_force(&resolved.to_string(), &details, unix_milliseconds()).await?)
}

async fn in_force(store: &Store) -> Result<Value, CommandError> {
    let text = store.campaign().await?.configuration_in_force;
    serde_json::from_str(&text).map_err(|error| {
        CommandError::Failed(format!(
            "damaged database: the configuration in force: {error}; restore the campaign from a backup"
        ))
    })
}

async fn record(store: &Store, origin: &Provenance) -> Result<(), CommandError> {
    let text = serde_json::to_string(origin).map_err(CommandError::failed)?;
    Ok(store.set_metadata(provenance::METADATA_KEY, &text).await?)
}

/// Reports where the campaign resumes.
async fn report_progress(
    store: &Store,
    origin: &Provenance,
    location: &Location,
) -> Result<(), CommandError> {
    let status = store.status().await?;
    let decisions = store.newest_mixture().await?.decision;
    let steps: u64 = status.walks.iter().map(|walk| walk.step).sum();
    let ended = status.walks.iter().filter(|walk| !walk.is_active()).count() as u64;
    let progress = if decisions == 0 {
        "no decisions yet".to_owned()
    } else {
        format!(
            "{}, {} ({ended} ended), {}, {}",
            count(decisions as u64, "decision"),
            count(status.walks.len() as u64, "walk"),
            count(steps, "step"),
            count(status.labels.labelled, "label")
        )
    };
    let name = &origin.name;
    match CampaignEnd::read(store, &status).await?.is_some() {
        true => log_and_print(format_args!("campaign '{name}' in {location} is finished: {progress}")),
        false => log_and_print(format_args!("resuming campaign '{name}' in {location}: {progress}")),
    }
    Ok(())
}

/// The configuration differs from that of the campaign in a key that may not change; it may belong to another campaign.
fn changed_content(
    campaign: &LoadedCampaign,
    location: &Location,
    other: Option<&Provenance>,
    refused: &Refused,
) -> CommandError {
    let at = config::location(&campaign.path, &campaign.text, refused.key());
    let elsewhere = elsewhere(location);
    let hint = other.map_or(String::new(), |known| {
        format!(" (the campaign in {location} is '{}', configured by {})", known.name, known.file.path)
    });
    CommandError::Input(format!("{at}: {refused}, or start another campaign {elsewhere}{hint}"))
}

/// The configuration is compatible, but the campaign was started with another file.
fn other_file(campaign: &LoadedCampaign, location: &Location, known: &Provenance) -> CommandError {
    let (given, name, file) = (campaign.path.display(), &known.name, &known.file.path);
    let elsewhere = elsewhere(location);
    CommandError::Input(format!(
        "{given}: the campaign in {location} is '{name}', which belongs to another configuration, {file}. Resume it with that \
         file, start another campaign {elsewhere}, or resume it with {given} by --adopt"
    ))
}

fn elsewhere(location: &Location) -> &'static str {
    match location {
        Location::Directory(_) => "with --directory",
        Location::Server(_) => "in another schema, set with ?schema=… in run.store",
    }
}
