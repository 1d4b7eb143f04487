//! `calmwalk store backup`

use std::path::PathBuf;

use serde_json::json;
use store::{DATABASE, Store, unix_milliseconds};

use super::{CampaignArgs, CommandError, ExitStatus};
use crate::cli::block_on;
use crate::output::{Bar, print, print_json};
use crate::wording::disk::megabytes;

const BAR: &str = "copying {bar:32} {percent} %  {eta} left";

/// Copy a campaign to a new directory, also while it runs
///
/// The backup is a campaign directory with a SQLite database, also if the store of the campaign is PostgreSQL. status, export
/// and other commands read it, and run can resume it (remove run.store from the configuration). It is a consistent snapshot,
/// and appears only when it is complete and on disk.
#[derive(Debug, clap::Args)]
pub struct StoreBackupArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Directory of the backup; it must not exist
    #[arg(value_name = "TARGET")]
    target: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl StoreBackupArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        block_on(self.backup())??;
        let target = self.target.display();
        let size = std::fs::metadata(self.target.join(DATABASE)).map_or(0, |file| file.len());
        if self.json {
            print_json(&json!({ "target": self.target, "bytes": size }))?;
            return Ok(ExitStatus::Done);
        }
        print(|out| writeln!(out, "backed up to {target}, {}", megabytes(size)))?;
        Ok(ExitStatus::Done)
    }

    async fn backup(&self) -> Result<(), CommandError> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        let mut bar = None;
        let report = |done, all| bar.get_or_insert_with(|| Bar::new(Some(all), BAR)).set(done, String::new);
        store.backup(&self.target, unix_milliseconds(), report).await?;
        store.close().await;
        Ok(())
    }
}
