//! Pages of figures and tables: one self-contained HTML file, each figure as SVG, PNG and CSV, each table as CSV. They contain
//! neither the date nor the place of their making, so the same content always gives the same bytes.

mod html;
pub mod style;
mod table;

use std::borrow::Cow;
use std::fs;
use std::io::Write;
use std::path::Path;

use ::figures::{to_png, to_svg};

pub use self::html::write;
pub use self::table::{PageTable, TableCell, count, percent, real, text};
use crate::atomic_file::{AtomicFile, cannot_create, cannot_write};
use crate::csv::Csv;
use crate::exit_status::CommandError;

/// Resolution of the images, dots per inch.
const RESOLUTION: f64 = 300.0;

/// A figure of the page, or the reason why it is missing.
pub struct FigureEntry {
    /// Name of its files.
    pub name: Cow<'static, str>,
    /// Its title.
    pub title: &'static str,
    /// The figure, or why it is missing.
    pub drawn: Result<FigureContent, String>,
}

/// A figure with its caption and data.
pub struct FigureContent {
    pub figure: ::figures::Figure,
    /// Supports `_{…}` and `^{…}`.
    pub caption: String,
    pub numbers: Csv,
}

/// A file that belongs to a page.
pub struct PageFile {
    /// Its path in the page's directory.
    pub path: String,
    /// Its content.
    pub bytes: Vec<u8>,
}

/// A heading and what is below it.
pub type Section<'a> = (&'static str, Vec<PageBlock<'a>>);

/// Content of a section. Figures and tables have numbers.
pub enum PageBlock<'a> {
    Paragraph(String),
    Figure(&'a FigureEntry, usize),
    Table(&'a PageTable, usize),
}

impl<'a> PageBlock<'a> {
    /// The figure of this name, numbered among those that exist.
    pub fn figure(all: &'a [FigureEntry], name: &str) -> Option<Self> {
        let place = all.iter().position(|part| part.name == name)?;
        let before = all[..place].iter().filter(|part| part.drawn.is_ok()).count();
        Some(Self::Figure(&all[place], before + 1))
    }

    /// The table of this name, numbered.
    pub fn table(all: &'a [PageTable], name: &str) -> Option<Self> {
        let place = all.iter().position(|table| table.name == name)?;
        Some(Self::Table(&all[place], place + 1))
    }
}

/// The files of figures and tables.
pub fn files(figures: Vec<FigureEntry>, tables: &[PageTable]) -> Result<Vec<PageFile>, CommandError> {
    let mut files = Vec::new();
    for part in figures {
        let Ok(drawn) = part.drawn else { continue };
        let path = |ending: &str| format!("figures/{}.{ending}", part.name);
        let image = to_png(&drawn.figure, RESOLUTION).map_err(CommandError::failed)?;
        let svg = to_svg(&drawn.figure);
        files.push(PageFile { path: path("svg"), bytes: svg.into_bytes() });
        files.push(PageFile { path: path("png"), bytes: image });
        files.push(PageFile { path: path("csv"), bytes: drawn.numbers.into_bytes() });
    }
    for table in tables {
        let path = format!("tables/{}.csv", table.name);
        files.push(PageFile { path, bytes: table.csv().into_bytes() });
    }
    Ok(files)
}

/// Writes the files into a directory, replacing those of an earlier page.
pub fn write_files(directory: &Path, files: &[PageFile]) -> Result<(), CommandError> {
    for PageFile { path, bytes } in files {
        let path = directory.join(path);
        path.parent().map_or(Ok(()), create_directory)?;
        let mut file = AtomicFile::create(&path)?;
        file.write_all(bytes).map_err(|error| cannot_write(&path, error))?;
        file.finish()?;
    }
    Ok(())
}

/// Creates the directory of a page.
pub fn create_directory(directory: &Path) -> Result<(), CommandError> {
    if directory.exists() && !directory.is_dir() {
        return Err(CommandError::Input(format!("{} is not a directory", directory.display())));
    }
    fs::create_dir_all(directory).map_err(|error| cannot_create(directory, error))
}
