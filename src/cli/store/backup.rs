//! `calmwalk store backup`

use std::path::PathBuf;

use store::{DATABASE, Store, unix_milliseconds};

use super::{CampaignLocation, ExitStatus, Failure};
use crate::cli::block_on;
use crate::disk_forecast::megabytes;
use crate::output::{Bar, print};

const BAR: &str = "copying {bar:32} {percent} %  {eta} left";

/// Copy a campaign into a new directory, also while it runs
///
/// The copy is a campaign's directory with a SQLite database, wherever the campaign is kept: status and export read it, and
/// run goes on with it (with run.store left out). It holds what was committed at one instant, and appears only when it is
/// whole and on the disk.
#[derive(Debug, clap::Args)]
pub struct Backup {
    #[command(flatten)]
    location: CampaignLocation,
    /// Directory to make; it must not exist
    #[arg(value_name = "TARGET")]
    target: PathBuf,
}

impl Backup {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        block_on(self.backup())??;
        let target = self.target.display();
        let size = std::fs::metadata(self.target.join(DATABASE)).map_or(0, |file| file.len());
        print(|out| writeln!(out, "the campaign is copied to {target}, {}", megabytes(size)))?;
        Ok(ExitStatus::Done)
    }

    async fn backup(&self) -> Result<(), Failure> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        let mut bar = None;
        let tell = |done, all| bar.get_or_insert_with(|| Bar::new(Some(all), BAR)).set(done, String::new);
        store.backup(&self.target, unix_milliseconds(), tell).await?;
        store.close().await;
        Ok(())
    }
}
