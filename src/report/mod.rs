//! Builds the report of a campaign: reads the store (`report_data`), draws the figures (`figures`) and writes the
//! page (`text`). The same campaign always gives the same bytes, since the report contains neither the date nor the
//! place of its making.

mod collections;
mod features;
mod figures;
mod report_data;
mod style;
mod tables;
#[cfg(test)]
mod tests;
mod text;
mod walk_traces;

use store::Store;

use self::report_data::ReportData;
use crate::csv::{self, Csv};
use crate::exit_status::CommandError;
use crate::page::{self, FigureContent, FigureEntry, PageFile};

/// Reads the campaign and builds all files of its report, the page first. Grades, force errors and features are those of this version
/// of the potential, or of the newest with labels.
pub async fn build(store: &Store, version: Option<u32>) -> Result<Vec<PageFile>, CommandError> {
    let data = ReportData::read(store, version).await?;
    let parts = figures::all(&data);
    let tables = tables::all(&data);
    let text = self::text::write(&data, &parts, &tables);
    let mut files = vec![PageFile { path: PAGE.to_owned(), bytes: text.into_bytes() }];
    files.extend(page::files(parts, &tables)?);
    Ok(files)
}

/// File name of the page.
pub const PAGE: &str = "report.html";
