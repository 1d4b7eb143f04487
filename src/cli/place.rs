//! Where a campaign is kept if nobody says so, and which campaign a directory means.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;
use store::{DATABASE, Location, Store};

use super::Failure;
use crate::campaign::Campaign;
use crate::config::compare;
use crate::origin::Origin;

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

/// Refuses to begin a campaign in its default directory while it is kept where earlier versions kept it: in the working directory.
///
/// # Errors
/// The campaign is there.
pub async fn refuse_if_kept_elsewhere(campaign: &Campaign, directory: &Path) -> Result<(), Failure> {
    let Some(earlier) = directory.file_name().map(PathBuf::from) else { return Ok(()) };
    let is_server = campaign.config.run.store.is_some();
    if is_server || holds_campaign(directory) || !holds_campaign(&earlier) {
        return Ok(());
    }
    // What cannot be read is no reason not to begin elsewhere.
    let Ok(store) = Store::open_read_only(&earlier).await else { return Ok(()) };
    let in_force: Option<Value> = store
        .campaign()
        .await
        .ok()
        .and_then(|found| serde_json::from_str(&found.configuration_in_force).ok());
    let found = Origin::of(&store).await.ok().flatten();
    store.close().await;
    let is_own = match found {
        Some(found) => found.file.path == Origin::new(&campaign.path, &campaign.text, directory).file.path,
        None => in_force.is_some_and(|in_force| compare(&in_force, &campaign.resolved()).is_ok()),
    };
    if !is_own {
        return Ok(());
    }
    let (config, earlier, directory) = (campaign.path.display(), earlier.display(), directory.display());
    Err(Failure::Input(format!(
        "{config}: a campaign of this configuration is in ./{earlier}, where earlier versions of calmwalk kept it; its default \
         directory is {directory} now. Run it with --directory {earlier} to go on with that campaign, or with --directory \
         {directory} to begin another"
    )))
}
