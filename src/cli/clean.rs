//! `calmwalk clean`

use std::path::{Path, PathBuf};

use store::CampaignLock;
use wire::shm_dir::{Removed, ShmDir, ShmDirError};

use super::{CommandError, ExitStatus};
use crate::output::{count, print};

/// Remove shared-memory files left behind by killed processes
///
/// Each run cleans up at its start and end. Use this command for killed campaigns that you do not resume. Skips running campaigns, and
/// removes nothing that a campaign needs to resume.
#[derive(Debug, clap::Args)]
pub struct CleanArgs {
    /// Directories of campaigns [default: all campaigns of this user on this host]
    #[arg(value_name = "DIR")]
    directories: Vec<PathBuf>,
}

impl CleanArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        if self.directories.is_empty() {
            bridge::remove_abandoned();
            for shared in ShmDir::all().map_err(CommandError::failed)? {
                let campaign = shared.campaign_directory();
                match clean(&shared, campaign) {
                    Ok(removed) => report(campaign.unwrap_or(shared.directory()), removed)?,
                    Err(CommandError::Input(message)) => print(|out| writeln!(out, "skipped: {message}"))?,
                    Err(failure) => return Err(failure),
                }
            }
        }
        for directory in &self.directories {
            let shared = ShmDir::for_campaign(directory).map_err(CommandError::input)?;
            report(directory, clean(&shared, Some(directory))?)?;
        }
        Ok(ExitStatus::Done)
    }
}

/// Removes the shared-memory files of a campaign, under the lock that keeps it from starting meanwhile.
fn clean(shared: &ShmDir, campaign: Option<&Path>) -> Result<Removed, CommandError> {
    // A campaign whose directory was deleted cannot start.
    let campaign = campaign.filter(|directory| directory.is_dir());
    let _lock = campaign.map(|directory| CampaignLock::acquire(directory, "calmwalk clean")).transpose()?;
    shared.remove().map_err(|error| match error {
        // In use although the directory is not locked: it may be invisible here, or renamed.
        ShmDirError::InUse { .. } => CommandError::input(error),
        error => CommandError::failed(error),
    })
}

fn report(directory: &Path, removed: Removed) -> Result<(), CommandError> {
    let Removed { files, bytes } = removed;
    let megabytes = bytes as f64 / 1e6;
    print(|out| {
        writeln!(
            out,
            "{}: removed {} from shared memory, {megabytes:.1} MB",
            directory.display(),
            count(files, "file")
        )
    })
}
