//! `calmwalk store compact`

use store::{CampaignLock, Store, unix_milliseconds};

use super::{CampaignLocation, Ended, Failure};
use crate::cli::block_on;
use crate::forecast::megabytes;
use crate::output::{print, say};

/// Give back the space that a campaign's store does not need
///
/// The campaign must not run meanwhile. The database is written anew, which takes room for a copy of it on the disk.
#[derive(Debug, clap::Args)]
pub struct Compact {
    #[command(flatten)]
    location: CampaignLocation,
    /// Drop the feature vectors of declined candidates: a replay of the campaign with other rules ends where they are missing
    #[arg(long)]
    drop_declined_features: bool,
}

impl Compact {
    pub fn run(self) -> Result<Ended, Failure> {
        let (before, after) = block_on(self.compact())??;
        print(|out| writeln!(out, "{} before, {} after", megabytes(before), megabytes(after)))?;
        Ok(Ended::Done)
    }

    async fn compact(&self) -> Result<(u64, u64), Failure> {
        let location = self.location.get()?;
        // What is not there must not be made by its lock.
        Store::open_read_only(&location).await?.close().await;
        let lock = CampaignLock::acquire_at(&location, "calmwalk store compact").await?;
        let store = Store::open(&location).await?.fenced_by(&lock);
        let before = store.size().await?;
        if self.drop_declined_features {
            let dropped = store.drop_declined_features(unix_milliseconds()).await?;
            say(format_args!(
                "features of {dropped} declined candidates dropped: a replay with other rules ends at the first of them"
            ));
        }
        store.compact().await?;
        let after = store.size().await?;
        store.close().await;
        Ok((before, after))
    }
}
