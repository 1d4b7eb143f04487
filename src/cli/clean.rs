//! `calmwalk clean`

use std::path::{Path, PathBuf};

use store::CampaignLock;
use wire::shm_dir::{Removed, ShmDir, ShmDirError};

use super::{Ended, Failure};
use crate::output::{count, print};

/// Remove what killed processes of a campaign left in shared memory
///
/// A run removes it at its start and at its end; this is for campaigns that were killed and will not go on. What belongs
/// to a campaign that is running is left alone, and no campaign loses anything that it needs to go on.
#[derive(Debug, clap::Args)]
pub struct Clean {
    /// Directories of campaigns [default: every campaign of this user on this host]
    #[arg(value_name = "DIR")]
    directories: Vec<PathBuf>,
}

impl Clean {
    pub fn run(self) -> Result<Ended, Failure> {
        if self.directories.is_empty() {
            for place in ShmDir::all().map_err(Failure::failed)? {
                let campaign = place.campaign_directory();
                match clean(&place, campaign) {
                    Ok(removed) => report(campaign.unwrap_or(place.directory()), removed)?,
                    Err(Failure::Input(message)) => print(|out| writeln!(out, "left alone: {message}"))?,
                    Err(failure) => return Err(failure),
                }
            }
        }
        for directory in &self.directories {
            let place = ShmDir::for_campaign(directory).map_err(Failure::input)?;
            report(directory, clean(&place, Some(directory))?)?;
        }
        Ok(Ended::Done)
    }
}

/// Removes a place while nobody can begin to run its campaign.
fn clean(place: &ShmDir, campaign: Option<&Path>) -> Result<Removed, Failure> {
    // Where the directory is gone there is no campaign left to run.
    let campaign = campaign.filter(|directory| directory.is_dir());
    let _lock = campaign.map(|directory| CampaignLock::acquire(directory, "calmwalk clean")).transpose()?;
    place.remove().map_err(|error| match error {
        // Its directory may not be visible here, or may have been renamed.
        ShmDirError::InUse { .. } => Failure::input(error),
        error => Failure::failed(error),
    })
}

fn report(directory: &Path, removed: Removed) -> Result<(), Failure> {
    let Removed { files, bytes } = removed;
    let megabytes = bytes as f64 / 1e6;
    print(|out| {
        writeln!(
            out,
            "{}: {} removed from shared memory, {megabytes:.1} MB",
            directory.display(),
            count(files, "file")
        )
    })
}
