//! `calmwalk store compact`

use store::{CampaignLock, Store, unix_milliseconds};

use super::{CampaignArgs, CommandError, ExitStatus};
use crate::cli::block_on;
use crate::output::{log_and_print, print};
use crate::wording::disk::megabytes;

/// Free unused space in a campaign's store
///
/// The campaign must not be running. Rewrites the database, which temporarily needs disk space for a copy of it.
#[derive(Debug, clap::Args)]
pub struct StoreCompactArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Also delete the feature vectors of declined candidates; `calmwalk replay --set` then stops at the first of them
    #[arg(long)]
    drop_declined_features: bool,
}

impl StoreCompactArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let (before, after) = block_on(self.compact())??;
        print(|out| writeln!(out, "{} before, {} after", megabytes(before), megabytes(after)))?;
        Ok(ExitStatus::Done)
    }

    async fn compact(&self) -> Result<(u64, u64), CommandError> {
        let location = self.location.get()?;
        // Fails if there is no campaign, before the lock creates files.
        Store::open_read_only(&location).await?.close().await;
        let lock = CampaignLock::acquire_at(&location, "calmwalk store compact").await?;
        let store = Store::open(&location).await?.fenced_by(&lock);
        let before = store.size().await?;
        if self.drop_declined_features {
            let dropped = store.drop_declined_features(unix_milliseconds()).await?;
            log_and_print(format_args!(
                "deleted the features of {dropped} declined candidates: calmwalk replay --set stops at the first of them"
            ));
        }
        store.compact().await?;
        let after = store.size().await?;
        store.close().await;
        Ok((before, after))
    }
}
