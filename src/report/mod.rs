//! Builds the report of a campaign: reads the store (`report_data`), draws the figures (`figures`) and writes the
//! page (`page`). The same campaign always gives the same bytes, since the report contains neither the date nor the
//! place of its making.

mod collections;
mod features;
mod figures;
mod page;
mod report_data;
mod style;
mod tables;
#[cfg(test)]
mod tests;

use ::figures::{to_png, to_svg};
use store::Store;

use self::report_data::ReportData;
use crate::csv::{self, Csv};
use crate::exit_status::Failure;

/// Resolution of the images, dots per inch.
const RESOLUTION: f64 = 300.0;

/// A figure of the page, or the reason why it is missing.
struct FigureEntry {
    /// Name of its files.
    name: &'static str,
    /// Its title.
    title: &'static str,
    /// The figure, or why it is missing.
    drawn: Result<FigureContent, String>,
}

/// A figure with its caption and data.
struct FigureContent {
    figure: ::figures::Figure,
    /// Supports `_{…}` and `^{…}`.
    caption: String,
    numbers: Csv,
}

/// A file of a report.
pub struct File {
    /// Its path in the report's directory.
    pub path: String,
    /// Its content.
    pub bytes: Vec<u8>,
}

/// Reads the campaign and builds all files of its report, the page first.
pub async fn build(store: &Store) -> Result<Vec<File>, Failure> {
    let data = ReportData::read(store).await?;
    let parts = figures::all(&data);
    let tables = tables::all(&data);
    let page = page::write(&data, &parts, &tables);
    let mut files = vec![File { path: PAGE.to_owned(), bytes: page.into_bytes() }];
    for part in parts {
        let Ok(drawn) = part.drawn else { continue };
        let path = |ending: &str| format!("figures/{}.{ending}", part.name);
        let image = to_png(&drawn.figure, RESOLUTION).map_err(Failure::failed)?;
        let svg = to_svg(&drawn.figure);
        files.push(File { path: path("svg"), bytes: svg.into_bytes() });
        files.push(File { path: path("png"), bytes: image });
        files.push(File { path: path("csv"), bytes: drawn.numbers.into_bytes() });
    }
    for table in &tables {
        let path = format!("tables/{}.csv", table.name);
        files.push(File { path, bytes: table.csv().into_bytes() });
    }
    Ok(files)
}

/// File name of the page.
pub const PAGE: &str = "report.html";
