//! `calmwalk report`

use std::path::PathBuf;

use serde_json::json;
use store::Store;

use super::force_errors::check_version;
use super::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::output::{count, print, print_json};
use crate::page::{create_directory, write_files};
use crate::report::{self, PAGE};

/// Write a report of a campaign: figures, tables, settings and provenance
///
/// Writes a self-contained HTML page for browser and print: the collected structures, biased walks compared with their
/// controls, force errors by grade, cost, failures and the structures without labels. Also writes each figure as SVG, PNG and
/// CSV, and each table as CSV. Works on running and finished campaigns and on backups; the same campaign gives the same bytes.
/// docs/report.md describes the figures.
#[derive(Debug, clap::Args)]
pub struct ReportArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Directory for the files, created if it does not exist; files of an earlier report are replaced
    #[arg(long, short, value_name = "DIR", default_value = "report")]
    output: PathBuf,
    /// Show grades, force errors and features of structures from walks with this version of the potential [default: the newest
    /// with labels]
    #[arg(long, value_name = "N")]
    version: Option<u32>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl ReportArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let location = self.location.get()?;
        // Fail before the long computation.
        create_directory(&self.output)?;
        let files = block_on(async {
            let store = Store::open_read_only(&location).await?;
            if let Some(version) = self.version {
                check_version(&store, version).await?;
            }
            let files = report::build(&store, self.version).await;
            store.close().await;
            files
        })??;
        write_files(&self.output, &files)?;
        let page = self.output.join(PAGE);
        if self.json {
            let names: Vec<_> = files.iter().map(|file| &file.path).collect();
            print_json(&json!({ "page": page, "directory": self.output, "files": names }))?;
            return Ok(ExitStatus::Done);
        }
        print(|out| {
            writeln!(
                out,
                "wrote {} and {} in the same directory",
                page.display(),
                count(files.len() - 1, "file")
            )
        })?;
        Ok(ExitStatus::Done)
    }
}
