//! `calmwalk store compact`

use serde_json::json;
use store::{CampaignLock, Store, unix_milliseconds};

use super::{CampaignArgs, CommandError, ExitStatus};
use crate::cli::block_on;
use crate::output::{count, log_and_print, print, print_json};
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
    /// Only show the size, and of how many candidates feature vectors would be deleted
    #[arg(long)]
    dry_run: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl StoreCompactArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        if self.dry_run {
            return self.show();
        }
        let (before, after) = block_on(self.compact())??;
        if self.json {
            print_json(&json!({ "bytes_before": before, "bytes": after, "dry_run": false }))?;
        } else {
            print(|out| writeln!(out, "{} before, {} after", megabytes(before), megabytes(after)))?;
        }
        Ok(ExitStatus::Done)
    }

    /// With `--dry-run`.
    fn show(&self) -> Result<ExitStatus, CommandError> {
        let (size, declined) = block_on(async {
            let store = Store::open_read_only(&self.location.get()?).await?;
            let found = (store.size().await?, store.declined_features().await?);
            store.close().await;
            Ok::<_, CommandError>(found)
        })??;
        let declined = if self.drop_declined_features { declined } else { 0 };
        if self.json {
            let found = json!({ "bytes_before": size, "declined_with_features": declined, "dry_run": true });
            print_json(&found)?;
            return Ok(ExitStatus::Done);
        }
        print(|out| {
            writeln!(out, "{} now; a copy of it would be written", megabytes(size))?;
            if self.drop_declined_features {
                let candidates = count(declined, "declined candidate");
                writeln!(out, "the features of {candidates} would be deleted")?;
            }
            writeln!(out, "nothing was changed")
        })?;
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
