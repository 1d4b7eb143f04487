//! Tables, rounded for the page and with full precision for a file.

use std::borrow::Cow;

use crate::csv::{self, Csv};

/// Largest number of rows on the page, for tables that grow with the campaign.
const MAX_PAGE_ROWS: usize = 60;

/// A table.
pub struct PageTable {
    /// Name of its file and its anchor on the page.
    pub name: Cow<'static, str>,
    /// Caption. Supports `_{…}` and `^{…}`, as the titles do.
    pub caption: String,
    /// Column titles.
    pub titles: Vec<&'static str>,
    /// Rows. A row of a single cell is a heading and is not written to the file.
    pub rows: Vec<Vec<TableCell>>,
    /// Largest number of rows on the page. The file has all.
    pub shown: usize,
}

/// A cell.
#[derive(Clone, Debug)]
pub struct TableCell {
    /// Rounded, for the page.
    pub shown: String,
    /// Full precision, for the file.
    pub exact: String,
    /// Numbers are right-aligned.
    pub is_number: bool,
}

impl PageTable {
    /// A table without rows.
    pub fn new(name: &'static str, caption: &str, titles: &[&'static str]) -> Self {
        Self {
            name: name.into(),
            caption: caption.into(),
            titles: titles.to_vec(),
            rows: Vec::new(),
            shown: MAX_PAGE_ROWS,
        }
    }

    /// Shows every row on the page.
    pub fn whole(self) -> Self {
        Self { shown: usize::MAX, ..self }
    }

    /// The content of its file.
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

/// A text.
pub fn text(words: impl Into<String>) -> TableCell {
    let words = words.into();
    TableCell { shown: words.clone(), exact: words, is_number: false }
}

/// A count.
pub fn count(number: u64) -> TableCell {
    TableCell { shown: super::style::grouped(number), exact: number.to_string(), is_number: true }
}

/// A number with a fixed number of decimals, or a dash.
pub fn real(x: impl Into<Option<f64>>, decimals: usize) -> TableCell {
    let x = x.into();
    let shown = crate::output::decimals(x, decimals).replace('-', "−");
    TableCell { shown, exact: csv::number(x), is_number: true }
}

/// A share, in percent on the page and in the file.
pub fn percent(share: Option<f64>) -> TableCell {
    real(share.map(|share| 100.0 * share), 1)
}
