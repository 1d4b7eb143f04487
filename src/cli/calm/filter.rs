//! `calmwalk calm filter`

use std::io::Write;
use std::path::{Path, PathBuf};

use analysis::GradedRow;
use figures::{to_png, to_svg};

use crate::atomic_file::{AtomicFile, cannot_write, check_outputs, refuse_to_replace};
use crate::cli::{CommandError, ExitStatus};
use crate::output::{count, print, print_json};
use crate::page::{create_directory, write_files};
use crate::reliability_filter::{self, ErrorColumns, FilterReport, InputColumns};

/// Resolution of a PNG, dots per inch.
const RESOLUTION: f64 = 300.0;

/// Compare structures below a threshold of the grade with random subsets
///
/// For each threshold, shows how many structures have at most this grade, and their mean absolute error. With --class-threshold, also
/// shows precision, recall and F1 for a class, such as the stable structures of Matbench Discovery. Beside each number are mean and
/// standard deviation over random subsets of the same size. If the grade predicts errors, the structures below the threshold have
/// smaller errors than these subsets.
///
/// With --output, also writes a self-contained HTML page with the errors by grade and this sweep, each figure as SVG, PNG and CSV, the
/// table as CSV, and all results as JSON.
///
/// The table is a CSV file (commas, titles in the first row) with one row for each structure. Errors have the unit of the table. True and
/// false are read as 1 and 0.
#[derive(Debug, clap::Args)]
pub struct CalmFilterArgs {
    /// Table with one row for each structure
    #[arg(value_name = "TABLE.csv")]
    table: PathBuf,
    /// Column of the grade, for example the largest γ of the structure's atoms
    #[arg(long, value_name = "COLUMN", default_value = "gamma_max")]
    grade: String,
    /// Column of the error; its sign does not matter
    #[arg(long, value_name = "COLUMN", conflicts_with_all = ["predicted", "actual"], required_unless_present = "predicted")]
    error: Option<String>,
    /// Column of the predicted value, together with --true: the error is their difference
    #[arg(long, value_name = "COLUMN", requires = "actual")]
    predicted: Option<String>,
    /// Column of the true value
    #[arg(long = "true", value_name = "COLUMN", requires = "predicted")]
    actual: Option<String>,
    /// Structures with a value up to this are in the class, such as 0 for the energy above the hull; in the unit of the values
    #[arg(long, value_name = "VALUE", conflicts_with = "error", allow_negative_numbers = true, value_parser = finite)]
    class_threshold: Option<f64>,
    /// Structures with a value above --class-threshold are in the class
    #[arg(long, requires = "class_threshold")]
    class_above: bool,
    /// Thresholds of the grade
    #[arg(
        long,
        value_name = "γ,…",
        value_delimiter = ',',
        value_parser = finite,
        default_value = "0.3,0.4,0.5,0.6,0.7,0.8,0.9,1,1.2,1.5,2,3,5"
    )]
    thresholds: Vec<f64>,
    /// Random subsets for each threshold
    #[arg(long, value_name = "N", default_value_t = 40, value_parser = clap::value_parser!(u32).range(..=100_000))]
    draws: u32,
    /// Random seed
    #[arg(long, value_name = "N", default_value_t = 42)]
    rng_seed: u64,
    /// Leave out rows in which one of the numbers is empty or nan
    #[arg(long)]
    skip_missing: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Also write the sweep to this file
    #[arg(long, value_name = "FILE.csv")]
    csv: Option<PathBuf>,
    /// Also draw the sweep
    #[arg(long, value_name = "FILE.svg|.png")]
    figure: Option<PathBuf>,
    /// Also write a page with figures and tables into this directory, created if it does not exist; files of an earlier page are replaced
    #[arg(long, short, value_name = "DIR")]
    output: Option<PathBuf>,
}

fn finite(text: &str) -> Result<f64, String> {
    let number = text.trim().parse().ok().filter(|number: &f64| number.is_finite());
    number.ok_or_else(|| "expected a finite number".to_owned())
}

impl CalmFilterArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let is_png = self.figure.as_deref().map(is_png).transpose()?;
        let outputs = self.csv.iter().chain(&self.figure).map(PathBuf::as_path);
        check_outputs(outputs, &[(&self.table, "the table")])?;
        let (rows, left_out) = reliability_filter::read(&self.table, &self.columns(), self.skip_missing)?;
        let report = FilterReport::new(&rows, left_out, &self.thresholds, self.draws, self.rng_seed);
        if let Some(path) = &self.csv {
            write(path, &reliability_filter::csv(&report).into_bytes())?;
        }
        if let (Some(path), Some(is_png)) = (&self.figure, is_png) {
            let figure = reliability_filter::draw(&report, &self.grade);
            match is_png {
                true => write(path, &to_png(&figure, RESOLUTION).map_err(CommandError::failed)?)?,
                false => write(path, to_svg(&figure).as_bytes())?,
            }
        }
        let page =
            self.output.as_deref().map(|directory| self.write_page(directory, &report, &rows)).transpose()?;
        match self.json {
            true => print_json(&report)?,
            false => print(|out| {
                reliability_filter::write(&report, out)?;
                page.map_or(Ok(()), |page| writeln!(out, "\n{page}"))
            })?,
        }
        Ok(ExitStatus::Done)
    }

    /// Writes the page and its files, and says so.
    fn write_page(
        &self,
        directory: &Path,
        report: &FilterReport,
        rows: &[GradedRow],
    ) -> Result<String, CommandError> {
        let files = reliability_filter::files(report, rows, &self.grade)?;
        for file in &files {
            refuse_to_replace(&directory.join(&file.path), [(self.table.as_path(), "the table")])?;
        }
        create_directory(directory)?;
        write_files(directory, &files)?;
        let page = directory.join(reliability_filter::PAGE);
        let others = count(files.len() - 1, "file");
        Ok(format!("wrote {} and {others} in the same directory", page.display()))
    }

    fn columns(&self) -> InputColumns<'_> {
        let errors = match (&self.predicted, &self.actual) {
            (Some(predicted), Some(actual)) => ErrorColumns::Values {
                predicted,
                actual,
                limit: self.class_threshold,
                above: self.class_above,
            },
            _ => ErrorColumns::Error(self.error.as_deref().unwrap_or("error")),
        };
        InputColumns { grade: &self.grade, errors }
    }
}

/// Whether the name is that of a PNG; otherwise it is that of an SVG.
fn is_png(path: &Path) -> Result<bool, CommandError> {
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    match extension.as_str() {
        "svg" => Ok(false),
        "png" => Ok(true),
        _ => {
            let shown = path.display();
            Err(CommandError::Input(format!("--figure {shown}: expected a name that ends in .svg or .png")))
        }
    }
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), CommandError> {
    let mut file = AtomicFile::create(path)?;
    file.write_all(bytes).map_err(|error| cannot_write(path, error))?;
    file.finish()
}
