//! Output of the commands: text and JSON on standard output, aligned tables and progress bars.

use std::fmt::Display;
use std::io::{self, BufWriter, ErrorKind, IsTerminal, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;
use store::Location;
use textwrap::{WordSeparator, WordSplitter, WrapAlgorithm};

use crate::exit_status::CommandError;

/// Shorter work shows no bar.
const BAR_AFTER: Duration = Duration::from_secs(1);

/// Writes to standard output. A closed pipe (`| head`) is not a failure.
pub fn print(write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<(), CommandError> {
    let mut out = BufWriter::new(io::stdout().lock());
    match write(&mut out).and_then(|()| out.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(CommandError::Failed(format!("cannot write to the standard output: {error}")))
        }
        _ => Ok(()),
    }
}

/// Whether only results, warnings and errors are printed.
static QUIET: AtomicBool = AtomicBool::new(false);

/// From now on, prints results, warnings and errors only.
pub fn set_quiet() {
    QUIET.store(true, Ordering::Relaxed);
}

/// Whether progress is not printed.
pub fn is_quiet() -> bool {
    QUIET.load(Ordering::Relaxed)
}

/// Prints a line about progress to standard error, unless that is not wanted.
pub fn print_progress(line: impl Display) {
    if !is_quiet() {
        print_stderr(line);
    }
}

/// Prints a line to standard error. Ignores errors, which must not stop any work.
pub fn print_stderr(line: impl Display) {
    let _ = writeln!(io::stderr().lock(), "{line}");
}

/// Prints a line to standard error, unless only warnings are wanted, and logs it.
pub fn log_and_print(line: impl Display) {
    tracing::info!("{line}");
    print_progress(line);
}

/// Prints a warning to standard error and logs it.
pub fn log_and_warn(line: impl Display) {
    tracing::warn!("{line}");
    print_stderr(line);
}

/// Warns if the connection to the store is unencrypted.
pub fn warn_if_unencrypted(location: &Location) {
    if let Location::Server(url) = location
        && url.is_unprotected()
    {
        log_and_warn(format_args!(
            "WARNING: the connection to {url} is not encrypted (sslmode=disable): anyone on the network can read and change \
             the data"
        ));
    }
}

/// Prints JSON to standard output.
pub fn print_json(value: &impl Serialize) -> Result<(), CommandError> {
    let text = serde_json::to_string_pretty(value).map_err(CommandError::failed)?;
    print(|out| writeln!(out, "{text}"))
}

/// A number with its noun: `1 label`, `2 labels`.
pub fn count<N: Display + PartialEq + From<u8>>(number: N, noun: &str) -> String {
    let plural = if number == N::from(1) { "" } else { "s" };
    format!("{number} {noun}{plural}")
}

/// `x` with a fixed number of decimals, or a dash.
pub fn decimals(x: Option<f64>, decimals: usize) -> String {
    x.map_or("–".to_owned(), |x| format!("{x:.decimals$}"))
}

/// A positive number with four significant digits, and at most `most` decimals.
pub fn four_digits(x: f64, most: usize) -> String {
    let decimals = (3.0 - x.abs().log10().floor()).clamp(0.0, most as f64) as usize;
    format!("{x:.decimals$}")
}

/// A range such as that of a bin. A missing bound leaves it open; without any bound the value is unknown.
pub fn range(above: Option<f64>, up_to: Option<f64>) -> String {
    match (above, up_to) {
        (Some(above), Some(up_to)) => format!("{above}–{up_to}"),
        (None, Some(up_to)) => format!("≤ {up_to}"),
        (Some(above), None) => format!("> {above}"),
        (None, None) => "unknown".into(),
    }
}

/// How text is wrapped at `width` columns: between words, each line as full as possible.
pub fn wrapped<'a>(width: usize) -> textwrap::Options<'a> {
    textwrap::Options::new(width)
        .word_separator(WordSeparator::AsciiSpace)
        .word_splitter(WordSplitter::NoHyphenation)
        .wrap_algorithm(WrapAlgorithm::FirstFit)
}

/// Rows with aligned columns.
pub struct TextTable {
    /// Width of each column and whether it is right-aligned, as numbers are.
    columns: Vec<(usize, bool)>,
    rows: Vec<Vec<String>>,
}

impl TextTable {
    /// A table with these column titles. Titles of numeric columns begin with `>`.
    pub fn new(titles: &[&str]) -> Self {
        let columns = titles.iter().map(|title| (0, title.starts_with('>'))).collect();
        let mut table = Self { columns, rows: Vec::new() };
        table.push(titles.iter().map(|title| title.trim_start_matches('>').to_owned()).collect());
        table
    }

    /// Adds a row.
    pub fn push(&mut self, row: Vec<String>) {
        for ((width, _), cell) in self.columns.iter_mut().zip(&row) {
            *width = (*width).max(cell.chars().count());
        }
        self.rows.push(row);
    }

    /// Removes columns without any value.
    pub fn drop_unknown(&mut self) {
        let is_known = |column: usize| {
            self.rows
                .iter()
                .skip(1)
                .any(|row| row.get(column).is_none_or(|cell| !cell.is_empty() && cell != "–"))
        };
        let kept: Vec<bool> = (0..self.columns.len()).map(is_known).collect();
        self.keep(&kept);
    }

    /// Removes columns with these titles, in this order, until all rows fit into `width` characters.
    pub fn drop_until_it_fits(&mut self, titles: &[&str], width: usize) {
        for title in titles {
            let all = self.columns.iter().map(|(width, _)| width + 2).sum::<usize>();
            if all <= width + 2 {
                return;
            }
            let kept: Vec<bool> = self.rows[0].iter().map(|cell| cell != title).collect();
            self.keep(&kept);
        }
    }

    fn keep(&mut self, kept: &[bool]) {
        let mut place = kept.iter();
        self.columns.retain(|_| place.next() == Some(&true));
        for row in &mut self.rows {
            let mut place = kept.iter();
            row.retain(|_| place.next() == Some(&true));
        }
    }

    /// Writes all rows.
    pub fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        self.lines().try_for_each(|line| writeln!(out, "{line}"))
    }

    /// All rows, without blanks at their ends.
    pub fn lines(&self) -> impl Iterator<Item = String> {
        self.rows.iter().map(|row| {
            let cells = row.iter().zip(&self.columns).map(|(cell, (width, number))| match number {
                true => format!("{cell:>width$}"),
                false => format!("{cell:<width$}"),
            });
            cells.collect::<Vec<_>>().join("  ").trim_end().to_owned()
        })
    }
}

/// A progress bar. It appears only on a terminal and only for long work.
pub struct Bar {
    bar: ProgressBar,
    begun: Instant,
}

impl Bar {
    /// A bar of this length (`None`: unknown) with an indicatif template.
    pub fn new(length: Option<u64>, template: &str) -> Self {
        let bar = ProgressBar::with_draw_target(length, ProgressDrawTarget::hidden());
        bar.set_style(
            ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()),
        );
        Self { bar, begun: Instant::now() }
    }

    /// Whether standard error is a terminal.
    pub fn is_shown(&self) -> bool {
        io::stderr().is_terminal() && !is_quiet()
    }

    /// Sets a length that was not known at first.
    pub fn set_length(&self, length: u64) {
        self.bar.set_length(length);
    }

    /// Hides the bar while `write` runs.
    pub fn suspend(&self, write: impl FnOnce()) {
        self.bar.suspend(write);
    }

    /// Moves the bar.
    pub fn set(&self, position: u64, message: impl FnOnce() -> String) {
        if self.bar.is_hidden() && self.begun.elapsed() > BAR_AFTER && !is_quiet() {
            self.bar.set_draw_target(ProgressDrawTarget::stderr());
        }
        if !self.bar.is_hidden() {
            self.bar.set_message(message());
        }
        self.bar.set_position(position);
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_digits_are_enough() {
        let shown = [2389.227, 41.3333, 1.5, 0.000_123_4].map(|x| four_digits(x, 4));
        assert_eq!(shown, ["2389", "41.33", "1.500", "0.0001"]);
    }

    #[test]
    fn columns_without_values_are_dropped() {
        let mut table = TextTable::new(&["name", ">steps/s", ">step"]);
        table.push(vec!["fcc".into(), "–".into(), "5".into()]);
        table.push(vec!["bcc".into(), "–".into(), "–".into()]);
        table.drop_unknown();
        assert_eq!(table.lines().collect::<Vec<_>>(), ["name  step", "fcc      5", "bcc      –"]);
    }

    #[test]
    fn columns_are_aligned_by_characters() {
        let mut table = TextTable::new(&["name", ">γ_max"]);
        table.push(vec!["é".into(), "1.50".into()]);
        table.push(vec!["fcc".into(), "12.00".into()]);
        let mut text = Vec::new();
        table.write(&mut text).unwrap();
        assert_eq!(String::from_utf8(text).unwrap(), "name  γ_max\né      1.50\nfcc   12.00\n");
    }
}
