//! Finds the campaign that a directory or URL on the command line refers to, and the default directory of a new one.

use std::fs;
use std::path::{Path, PathBuf};

use monitor::provenance::Provenance;
use serde_json::Value;
use store::{DATABASE, Location, Store};

use super::CommandError;
use crate::campaign::LoadedCampaign;
use crate::config::compare;

/// The default directory of a campaign: the path of its configuration without the extension.
pub fn default_directory(config: &Path) -> PathBuf {
    config.with_extension("")
}

/// Parses an argument: the URL of a server, or a directory that leads to one campaign.
pub fn parse(text: &Path) -> Result<Location, CommandError> {
    let location = text.to_str().map_or_else(|| Ok(Location::from(text)), str::parse)?;
    match location {
        Location::Directory(directory) => find_campaign(&directory),
        server @ Location::Server(_) => Ok(server),
    }
}

/// Formats a location as a shell argument.
pub fn shell_argument(location: &Location) -> String {
    match location {
        Location::Directory(_) => location.to_string(),
        // '?' and '&' are special characters of the shell.
        Location::Server(url) => format!("'{url}'"),
    }
}

/// Finds the campaign of a directory: the campaign in the directory itself, else the one whose configuration is in it (as after
/// `calmwalk init`), else the only one in its subdirectories. Without any, returns the directory itself.
///
/// # Errors
/// There are several campaigns.
fn find_campaign(directory: &Path) -> Result<Location, CommandError> {
    if has_campaign(directory) || !directory.is_dir() {
        return Ok(directory.into());
    }
    let entries = || fs::read_dir(directory).into_iter().flatten().flatten().map(|entry| entry.path());
    let configs = entries().filter(|path| path.extension().is_some_and(|extension| extension == "toml"));
    let mut found: Vec<_> = configs.filter_map(|config| campaign_of_config(&config)).collect();
    if found.is_empty() {
        found = entries().filter(|path| has_campaign(path)).map(Location::from).collect();
    }
    let mut names: Vec<_> = found.iter().map(ToString::to_string).collect();
    names.sort();
    match found.len() {
        0 => Ok(directory.into()),
        1 => Ok(found.remove(0)),
        several => Err(CommandError::Input(format!(
            "{} contains {several} campaigns: name one of {}",
            directory.display(),
            names.join(", ")
        ))),
    }
}

/// The campaign of a configuration, if it is in the default directory or on a server.
fn campaign_of_config(config: &Path) -> Option<Location> {
    let directory = default_directory(config);
    if has_campaign(&directory) {
        return Some(directory.into());
    }
    let content: toml::Table = fs::read_to_string(config).ok()?.parse().ok()?;
    let url = content.get("run")?.get("store")?.as_str()?;
    url.parse().ok().filter(|location| matches!(location, Location::Server(_)))
}

fn has_campaign(directory: &Path) -> bool {
    directory.join(DATABASE).is_file()
}

/// Checks, before a campaign starts in its default directory, that there is no campaign of this configuration where earlier
/// versions kept it: in the directory of that name below the working directory, or beside the configuration itself.
///
/// # Errors
/// There is such a campaign.
pub async fn check_former_locations(campaign: &LoadedCampaign, directory: &Path) -> Result<(), CommandError> {
    if campaign.config.run.store.is_some() || has_campaign(directory) {
        return Ok(());
    }
    let candidates = [
        directory.file_name().map(PathBuf::from),
        directory.parent().map(|parent| Path::new(".").join(parent)),
    ];
    for former in candidates.into_iter().flatten().filter(|former| has_campaign(former)) {
        if is_campaign_of(&former, campaign, directory).await {
            let (config, former, directory) =
                (campaign.path.display(), former.display(), directory.display());
            return Err(CommandError::Input(format!(
                "{config}: {former} already contains a campaign of this configuration, but the default directory is {directory}. Use \
                 --directory {former} to continue that campaign, or --directory {directory} to start a new one"
            )));
        }
    }
    Ok(())
}

/// Whether the campaign in `former` belongs to this configuration. A campaign that cannot be read does not.
async fn is_campaign_of(former: &Path, campaign: &LoadedCampaign, directory: &Path) -> bool {
    let Ok(store) = Store::open_read_only(former).await else { return false };
    let in_force = store.campaign().await.ok().map(|found| found.configuration_in_force);
    let found = Provenance::read(&store).await.ok().flatten();
    store.close().await;
    match found {
        Some(found) => {
            found.file.path == Provenance::new(&campaign.path, &campaign.text, directory).file.path
        }
        // Campaigns of early versions do not record the file: compare the content.
        None => {
            let in_force = in_force.and_then(|text| serde_json::from_str::<Value>(&text).ok());
            in_force.is_some_and(|in_force| compare(&in_force, &campaign.resolved()).is_ok())
        }
    }
}
