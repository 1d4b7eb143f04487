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
    /// Show what would be removed, and remove nothing
    #[arg(long)]
    dry_run: bool,
}

impl CleanArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        if self.directories.is_empty() {
            if !self.dry_run {
                bridge::remove_abandoned();
            }
            for shared in ShmDir::all().map_err(CommandError::failed)? {
                let campaign = shared.campaign_directory();
                match self.clean(&shared, campaign) {
                    Ok(removed) => self.report(campaign.unwrap_or(shared.directory()), removed)?,
                    Err(CommandError::Input(message)) => print(|out| writeln!(out, "skipped: {message}"))?,
                    Err(failure) => return Err(failure),
                }
            }
        }
        for directory in &self.directories {
            let shared = ShmDir::for_campaign(directory).map_err(CommandError::input)?;
            self.report(directory, self.clean(&shared, Some(directory))?)?;
        }
        if self.dry_run {
            print(|out| writeln!(out, "nothing was changed"))?;
        }
        Ok(ExitStatus::Done)
    }

    /// Removes the shared-memory files of a campaign, under the lock that keeps it from starting meanwhile.
    fn clean(&self, shared: &ShmDir, campaign: Option<&Path>) -> Result<Removed, CommandError> {
        // A campaign whose directory was deleted cannot start.
        let campaign = campaign.filter(|directory| directory.is_dir());
        let _lock =
            campaign.map(|directory| CampaignLock::acquire(directory, "calmwalk clean")).transpose()?;
        let removed = if self.dry_run { shared.removable() } else { shared.remove() };
        removed.map_err(|error| match error {
            // In use although the directory is not locked: it may be invisible here, or renamed.
            ShmDirError::InUse { .. } => CommandError::input(error),
            error => CommandError::failed(error),
        })
    }

    fn report(&self, directory: &Path, Removed { files, bytes }: Removed) -> Result<(), CommandError> {
        let (megabytes, files) = (bytes as f64 / 1e6, count(files, "file"));
        let (directory, would) = (directory.display(), if self.dry_run { "would remove" } else { "removed" });
        print(|out| writeln!(out, "{directory}: {would} {files} from shared memory, {megabytes:.1} MB"))
    }
}
