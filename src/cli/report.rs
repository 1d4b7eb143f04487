//! `calmwalk report`

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use store::Store;

use super::{CampaignLocation, ExitStatus, Failure, block_on};
use crate::atomic_file::{AtomicFile, cannot_create};
use crate::output::{count, print};
use crate::report::{self, File, PAGE};

/// Write what came of a campaign as a document: figures, tables, settings, provenance
///
/// One HTML file that needs nothing else, in a browser and on paper: what was collected and why, biased walks against their
/// controls, force errors by grade, cost, failures and what has no label because of them. Beside it each figure as SVG, PNG and
/// CSV, and each table as CSV. Works while the campaign runs, after it ended, and of a copy, and changes nothing. The same campaign
/// gives the same bytes. docs/report.md says what each figure shows.
#[derive(Debug, clap::Args)]
pub struct Report {
    #[command(flatten)]
    location: CampaignLocation,
    /// Directory to write to, made if it is not there; files of an earlier report in it are replaced
    #[arg(long, short, value_name = "DIR", default_value = "report")]
    output: PathBuf,
}

impl Report {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        let location = self.location.get()?;
        // Before the long work.
        make(&self.output)?;
        let files = block_on(async {
            let store = Store::open_read_only(&location).await?;
            let files = report::build(&store).await;
            store.close().await;
            files
        })??;
        for File { path, bytes } in &files {
            let path = self.output.join(path);
            path.parent().map_or(Ok(()), make)?;
            let mut file = AtomicFile::create(&path)?;
            file.write_all(bytes).map_err(|error| crate::atomic_file::cannot_write(&path, error))?;
            file.finish()?;
        }
        let page = self.output.join(PAGE);
        print(|out| writeln!(out, "{} and {} beside it", page.display(), count(files.len() - 1, "file")))?;
        Ok(ExitStatus::Done)
    }
}

fn make(directory: &Path) -> Result<(), Failure> {
    fs::create_dir_all(directory).map_err(|error| cannot_create(directory, error))
}
