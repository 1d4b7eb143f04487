//! Where a campaign is kept if nobody says so, and which campaign a directory means.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;
use store::{DATABASE, Location, Store};

use super::Failure;
use crate::campaign::Campaign;
use crate::config::compare;
use crate::provenance::Provenance;

/// The directory of a campaign if none is named: beside its configuration, called as that is without its extension.
pub fn default_directory(config: &Path) -> PathBuf {
    config.with_extension("")
}

/// The place that a text of the command line means: the URL of a server, or the campaign that a directory holds.
pub fn location(text: &Path) -> Result<Location, Failure> {
    let location = text.to_str().map_or_else(|| Ok(Location::from(text)), str::parse)?;
    match location {
        Location::Directory(directory) => campaign_of(&directory),
        server @ Location::Server(_) => Ok(server),
    }
}

/// The location as an argument of a command.
pub fn shown(location: &Location) -> String {
    match location {
        Location::Directory(_) => location.to_string(),
        // The shell has uses of its own for '?' and '&'.
        Location::Server(url) => format!("'{url}'"),
    }
}

/// The campaign that a directory means: the one in it, else the one whose configuration is in it (as `calmwalk init` leaves it),
/// else the only one in the directories below it. Where there is none, the directory itself.
///
/// # Errors
/// Several campaigns.
fn campaign_of(directory: &Path) -> Result<Location, Failure> {
    if holds_campaign(directory) || !directory.is_dir() {
        return Ok(directory.into());
    }
    let entries = || fs::read_dir(directory).into_iter().flatten().flatten().map(|entry| entry.path());
    let configs = entries().filter(|path| path.extension().is_some_and(|extension| extension == "toml"));
    let mut found: Vec<_> = configs.filter_map(|config| campaign_by(&config)).collect();
    if found.is_empty() {
        found = entries().filter(|path| holds_campaign(path)).map(Location::from).collect();
    }
    let mut shown: Vec<_> = found.iter().map(ToString::to_string).collect();
    shown.sort();
    match found.len() {
        0 => Ok(directory.into()),
        1 => Ok(found.remove(0)),
        several => Err(Failure::Input(format!(
            "{} holds {several} campaigns: name one of {}",
            directory.display(),
            shown.join(", ")
        ))),
    }
}

/// Where the campaign of a configuration is kept, if it is in the default directory, or on a server.
fn campaign_by(config: &Path) -> Option<Location> {
    let beside = default_directory(config);
    if holds_campaign(&beside) {
        return Some(beside.into());
    }
    let content: toml::Table = fs::read_to_string(config).ok()?.parse().ok()?;
    let url = content.get("run")?.get("store")?.as_str()?;
    url.parse().ok().filter(|location| matches!(location, Location::Server(_)))
}

fn holds_campaign(directory: &Path) -> bool {
    directory.join(DATABASE).is_file()
}

/// Refuses to begin a campaign in its default directory while one of this configuration is in the directory of that name below the
/// working directory, where earlier versions kept it, or beside the configuration itself.
///
/// # Errors
/// The campaign is there.
pub async fn refuse_if_kept_elsewhere(campaign: &Campaign, directory: &Path) -> Result<(), Failure> {
    if campaign.config.run.store.is_some() || holds_campaign(directory) {
        return Ok(());
    }
    let places = [
        directory.file_name().map(PathBuf::from),
        directory.parent().map(|parent| Path::new(".").join(parent)),
    ];
    for place in places.into_iter().flatten().filter(|place| holds_campaign(place)) {
        if holds_campaign_of(&place, campaign, directory).await {
            let (config, place, directory) = (campaign.path.display(), place.display(), directory.display());
            return Err(Failure::Input(format!(
                "{config}: a campaign of this configuration is in {place}, and the default directory is {directory}. Run it with \
                 --directory {place} to go on with that campaign, or with --directory {directory} to begin another"
            )));
        }
    }
    Ok(())
}

/// Whether the campaign in a directory is one of this configuration. What cannot be read is none.
async fn holds_campaign_of(place: &Path, campaign: &Campaign, directory: &Path) -> bool {
    let Ok(store) = Store::open_read_only(place).await else { return false };
    let in_force = store.campaign().await.ok().map(|found| found.configuration_in_force);
    let found = Provenance::read(&store).await.ok().flatten();
    store.close().await;
    match found {
        Some(found) => {
            found.file.path == Provenance::new(&campaign.path, &campaign.text, directory).file.path
        }
        // Of an early version: as far as its content says.
        None => {
            let in_force = in_force.and_then(|text| serde_json::from_str::<Value>(&text).ok());
            in_force.is_some_and(|in_force| compare(&in_force, &campaign.resolved()).is_ok())
        }
    }
}
