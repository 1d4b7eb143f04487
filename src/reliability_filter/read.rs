//! Reads the table.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use analysis::GradedRow;

use crate::csv_reader::{CsvReader, CsvRow};
use crate::exit_status::CommandError;

/// Cells that stand for a missing number, besides empty ones.
const MISSING: [&str; 5] = ["nan", "na", "n/a", "null", "none"];

/// Titles of the columns to read.
pub struct InputColumns<'a> {
    pub grade: &'a str,
    pub errors: ErrorColumns<'a>,
}

/// Where errors come from.
pub enum ErrorColumns<'a> {
    /// A column of errors, signed or not.
    Error(&'a str),
    /// A predicted and a true value. A structure is in the class if its value is at most the limit (above it if `above`).
    Values { predicted: &'a str, actual: &'a str, limit: Option<f64>, above: bool },
}

/// Reads all rows, and counts those without one of the numbers, which is an error unless `skip_missing`.
pub fn read(
    path: &Path,
    columns: &InputColumns,
    skip_missing: bool,
) -> Result<(Vec<GradedRow>, usize), CommandError> {
    let file = File::open(path)
        .map_err(|error| CommandError::Input(format!("{}: cannot be opened: {error}", path.display())))?;
    let mut table = CsvReader::new(BufReader::new(file)).map_err(|error| error.in_file(path))?;
    let place = |title| table.column(title).map(|place| (title, place)).map_err(|error| error.in_file(path));
    let titles = match columns.errors {
        ErrorColumns::Error(error) => vec![columns.grade, error],
        ErrorColumns::Values { predicted, actual, .. } => vec![columns.grade, predicted, actual],
    };
    let places = titles.into_iter().map(place).collect::<Result<Vec<_>, _>>()?;
    let (mut rows, mut left_out) = (Vec::new(), 0);
    while let Some(row) = table.next().map_err(|error| error.in_file(path))? {
        let mut numbers = Vec::with_capacity(places.len());
        for (title, place) in &places {
            match number(&row, title, *place, path)? {
                Some(number) => numbers.push(number),
                None if skip_missing => break,
                None => {
                    let place = format!("{}:{}", path.display(), row.line);
                    let message =
                        format!("column '{title}' has no number; --skip-missing leaves such rows out");
                    return Err(CommandError::Input(format!("{place}: {message}")));
                }
            }
        }
        match numbers.len() == places.len() {
            true => rows.push(graded(numbers[0], &numbers[1..], &columns.errors)),
            false => left_out += 1,
        }
    }
    if rows.is_empty() {
        return Err(CommandError::Input(format!("{}: no row has all numbers", path.display())));
    }
    Ok((rows, left_out))
}

/// The number of a cell, 1 or 0 of a class written as true or false; `None` if it is missing.
fn number(row: &CsvRow, title: &str, place: usize, path: &Path) -> Result<Option<f64>, CommandError> {
    let cell = row.cells[place].trim();
    let found = match cell.to_lowercase().as_str() {
        "" => return Ok(None),
        word if MISSING.contains(&word) => return Ok(None),
        "true" => Some(1.0),
        "false" => Some(0.0),
        _ => cell.parse::<f64>().ok().filter(|number| number.is_finite()),
    };
    found.map(Some).ok_or_else(|| {
        let place = format!("{}:{}", path.display(), row.line);
        let expected = "expected a finite number, true or false";
        CommandError::Input(format!("{place}: column '{title}' is '{cell}', {expected}"))
    })
}

fn graded(grade: f64, values: &[f64], columns: &ErrorColumns) -> GradedRow {
    match (columns, values) {
        (ErrorColumns::Values { limit, above, .. }, [predicted, actual]) => {
            let is_in = |value: f64| limit.map(|limit| (value <= limit) != *above);
            GradedRow { grade, error: predicted - actual, class: is_in(*predicted).zip(is_in(*actual)) }
        }
        _ => GradedRow { grade, error: values[0], class: None },
    }
}
