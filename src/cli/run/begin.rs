//! The start of a run: which campaign it is, whether it is the one that the configuration means, and where it goes on.

use std::path::Path;

use serde_json::Value;
use store::{Location, Store, unix_milliseconds};

use crate::campaign::Campaign;
use crate::config::{Change, Refused, compare, place};
use crate::origin::{self, Match, Origin};
use crate::outcome::Failure;
use crate::output::{count, say};

/// Records of a new campaign what it began with.
pub async fn begun(store: &Store, origin: &Origin, location: &Location) -> Result<(), Failure> {
    record(store, origin).await?;
    say(format_args!("campaign '{}' begins in {location}, with {}", origin.name, origin.file.path));
    Ok(())
}

/// Checks that the campaign in the store is the one of this configuration, and applies what may have changed.
pub async fn go_on(
    campaign: &Campaign,
    store: &Store,
    location: &Location,
    origin: &Origin,
    adopt: bool,
) -> Result<(), Failure> {
    let known = Origin::of(store).await?;
    let holds_campaign = matches!(location, Location::Directory(_));
    let how = known.as_ref().map(|known| known.compare(origin, holds_campaign, Path::exists));
    let other = known.as_ref().filter(|_| how == Some(Match::Other));
    let resolved = campaign.resolved();
    let changes = compare(&in_force(store).await?, &resolved)
        .map_err(|refused| other_content(campaign, location, other, &refused))?;
    match other {
        Some(known) if !adopt => return Err(other_file(campaign, location, known)),
        Some(known) => {
            say(format_args!("configuration: {} takes the place of {}", origin.file.path, known.file.path))
        }
        None => {}
    }
    record(store, &known.map_or_else(|| origin.clone(), |known| known.continued(origin))).await?;
    tell_where(store, origin, location).await?;
    if changes.is_empty() {
        return Ok(());
    }
    changes.iter().for_each(|change| say(format_args!("configuration: {change}")));
    store.add_seed_structures(&campaign.stored_seeds()).await?;
    let details: Vec<_> = changes.iter().map(Change::detail).collect();
    Ok(store.set_configuration_in_force(&resolved.to_string(), &details, unix_milliseconds()).await?)
}

async fn in_force(store: &Store) -> Result<Value, Failure> {
    let text = store.campaign().await?.configuration_in_force;
    serde_json::from_str(&text).map_err(|error| {
        Failure::Failed(format!(
            "damaged database: the configuration in force: {error}; restore the campaign from a backup"
        ))
    })
}

async fn record(store: &Store, origin: &Origin) -> Result<(), Failure> {
    let note = serde_json::to_string(origin).map_err(Failure::failed)?;
    Ok(store.set_metadata(origin::NOTE, &note).await?)
}

/// Says where the campaign goes on.
async fn tell_where(store: &Store, origin: &Origin, location: &Location) -> Result<(), Failure> {
    let status = store.status().await?;
    let decisions = store.newest_mixture().await?.decision;
    let steps: u64 = status.walks.iter().map(|walk| walk.step).sum();
    let over = status.walks.iter().filter(|walk| !walk.is_active()).count() as u64;
    let from = if decisions == 0 {
        "nothing was decided yet".to_owned()
    } else {
        format!(
            "after decision {decisions}: {}, {over} of them over, {}, {}",
            count(status.walks.len() as u64, "walk"),
            count(steps, "step"),
            count(status.labels.labelled, "label")
        )
    };
    let goes_on = if status.finished { "is finished" } else { "goes on" };
    say(format_args!("campaign '{}' in {location} {goes_on}; {from}", origin.name));
    Ok(())
}

/// The configuration has another content than the campaign, perhaps since it is another campaign's.
fn other_content(
    campaign: &Campaign,
    location: &Location,
    other: Option<&Origin>,
    refused: &Refused,
) -> Failure {
    let at = place(&campaign.path, &campaign.text, refused.key());
    let elsewhere = elsewhere(location);
    let hint = other.map_or(String::new(), |known| {
        format!(" (the campaign in {location} is '{}', by {})", known.name, known.file.path)
    });
    Failure::Input(format!("{at}: {refused}, or start another campaign {elsewhere}{hint}"))
}

/// The configuration would do, and is not the campaign's.
fn other_file(campaign: &Campaign, location: &Location, known: &Origin) -> Failure {
    let (given, name, file) = (campaign.path.display(), &known.name, &known.file.path);
    let elsewhere = elsewhere(location);
    Failure::Input(format!(
        "{given}: the campaign in {location} is '{name}', which belongs to another configuration, {file}. Go on with it by that \
         file, or start another campaign {elsewhere}; --adopt goes on with it by {given}"
    ))
}

fn elsewhere(location: &Location) -> &'static str {
    match location {
        Location::Directory(_) => "with --directory",
        Location::Server(_) => "in another schema, which ?schema=… in run.store names",
    }
}
