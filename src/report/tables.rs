//! The tables of a report: what people read, and every digit of it for a file.

mod facts;
mod labels;
mod seeds;
mod settings;

use super::csv::{self, Csv};
use super::report_data::ReportData;

pub use facts::collection_rule;

/// Rows of a table on the page, where it grows with the campaign.
const ROWS: usize = 60;

/// Rows below titles.
pub struct Table {
    /// Name of its file, and the place on the page.
    pub name: &'static str,
    /// What it shows; with `_{…}` and `^{…}`, as the titles.
    pub caption: String,
    /// Titles of columns.
    pub titles: Vec<&'static str>,
    /// Rows. One of a single cell is a heading of those below it, and is not in the file.
    pub rows: Vec<Vec<Cell>>,
    /// Rows on the page, at most; the file has all.
    pub shown: usize,
}

/// A cell.
#[derive(Clone, Debug)]
pub struct Cell {
    /// As people read it.
    pub shown: String,
    /// With every digit.
    pub exact: String,
    /// Numbers stand to the right.
    pub is_number: bool,
}

impl Table {
    fn new(name: &'static str, caption: &str, titles: &[&'static str]) -> Self {
        Self { name, caption: caption.into(), titles: titles.to_vec(), rows: Vec::new(), shown: ROWS }
    }

    /// The same with every row on the page.
    fn whole(self) -> Self {
        Self { shown: usize::MAX, ..self }
    }

    /// Its file.
    pub fn csv(&self) -> Csv {
        let titles: Vec<_> = self.titles.iter().map(|title| figures::plain(title)).collect();
        let titles: Vec<_> = titles.iter().map(String::as_str).collect();
        let mut csv = Csv::new(&titles);
        for row in self.rows.iter().filter(|row| row.len() > 1) {
            let cells: Vec<_> = row.iter().map(|cell| cell.exact.as_str()).collect();
            csv.push(&cells);
        }
        csv
    }
}

/// Words.
fn text(words: impl Into<String>) -> Cell {
    let words = words.into();
    Cell { shown: words.clone(), exact: words, is_number: false }
}

/// A count.
fn count(number: u64) -> Cell {
    Cell { shown: super::style::grouped(number), exact: number.to_string(), is_number: true }
}

/// A number with so many decimals for people, a dash where there is none.
fn real(x: impl Into<Option<f64>>, decimals: usize) -> Cell {
    let x = x.into();
    Cell { shown: crate::output::decimals(x, decimals), exact: csv::number(x), is_number: true }
}

/// A share, shown in percent; its file has the same.
fn percent(share: Option<f64>) -> Cell {
    real(share.map(|share| 100.0 * share), 1)
}

/// All that have rows, in the order of the page.
pub fn all(data: &ReportData) -> Vec<Table> {
    let mut tables = vec![facts::summary(data), seeds::of(data)];
    if let Some(found) = &data.labels {
        tables.extend([
            labels::correlations(&found.learned),
            labels::quantiles("quantiles-gamma", "γ", &found.learned.all.gamma),
            labels::quantiles("quantiles-gamma-nbr", "γ_{nbr}", &found.learned.all.gamma_nbr),
            labels::energy_offsets(&found.learned),
            labels::failures(&found.failures),
            labels::unlabelled(&found.unlabelled),
        ]);
    }
    tables.extend([settings::settings(data), facts::provenance(data)]);
    tables.retain(|table| !table.rows.is_empty());
    tables
}
