//! Reads comma-separated values (RFC 4180) row by row. Errors name line and column.

use std::io::{self, BufRead};
use std::path::Path;

use crate::exit_status::CommandError;

/// Rows of a table whose first row has the titles.
pub struct CsvReader<R> {
    input: R,
    /// Number of the last line read.
    line: usize,
    titles: Vec<String>,
}

/// A row of the table.
#[derive(Debug, PartialEq)]
pub struct CsvRow {
    /// Where it begins, from 1.
    pub line: usize,
    /// As many as there are titles.
    pub cells: Vec<String>,
}

/// Why a table cannot be read.
#[derive(Debug)]
pub struct CsvError {
    /// From 1; `None` if the table as a whole is at fault.
    line: Option<usize>,
    fault: Fault,
}

#[derive(Debug, thiserror::Error)]
enum Fault {
    #[error("cannot be read: {0}")]
    Io(#[from] io::Error),
    #[error("no rows: expected a first row with the titles of columns")]
    Empty,
    #[error("found {found} cells, expected {expected} as in the first row")]
    Cells { found: usize, expected: usize },
    #[error("a quoted cell does not end")]
    OpenQuote,
    #[error("found '{found}' after quoted cell {cell}, expected a comma")]
    AfterQuote { cell: usize, found: char },
    #[error("two columns are called '{0}'")]
    Twice(String),
    #[error("no column is called '{title}', the columns are {titles}")]
    Missing { title: String, titles: String },
}

impl CsvError {
    /// Wrong input, which names the file.
    pub fn in_file(self, path: &Path) -> CommandError {
        let place = self.line.map_or(String::new(), |line| format!(":{line}"));
        CommandError::Input(format!("{}{place}: {}", path.display(), self.fault))
    }
}

impl From<Fault> for CsvError {
    fn from(fault: Fault) -> Self {
        Self { line: None, fault }
    }
}

impl Fault {
    fn at(self, line: usize) -> CsvError {
        CsvError { line: Some(line), fault: self }
    }
}

impl<R: BufRead> CsvReader<R> {
    /// Reads the titles.
    pub fn new(input: R) -> Result<Self, CsvError> {
        let mut reader = Self { input, line: 0, titles: Vec::new() };
        let (_, titles) = reader.record()?.ok_or(Fault::Empty)?;
        reader.titles =
            titles.iter().map(|title| title.trim_start_matches('\u{feff}').trim().to_owned()).collect();
        Ok(reader)
    }

    /// Index of the column with this title.
    pub fn column(&self, title: &str) -> Result<usize, CsvError> {
        let mut places = (0..self.titles.len()).filter(|place| self.titles[*place] == title);
        match (places.next(), places.next()) {
            (Some(place), None) => Ok(place),
            (Some(_), Some(_)) => Err(Fault::Twice(title.to_owned()).into()),
            (None, _) => {
                Err(Fault::Missing { title: title.to_owned(), titles: self.titles.join(", ") }.into())
            }
        }
    }

    /// The next row; empty lines are skipped.
    pub fn next(&mut self) -> Result<Option<CsvRow>, CsvError> {
        let Some((line, cells)) = self.record()? else { return Ok(None) };
        match cells.len() == self.titles.len() {
            true => Ok(Some(CsvRow { line, cells })),
            false => Err(Fault::Cells { found: cells.len(), expected: self.titles.len() }.at(line)),
        }
    }

    /// The cells of the next line that is not empty, and further lines if a quoted cell continues.
    fn record(&mut self) -> Result<Option<(usize, Vec<String>)>, CsvError> {
        let mut text = String::new();
        while text.trim().is_empty() {
            text.clear();
            if self.read_line(&mut text)? == 0 {
                return Ok(None);
            }
        }
        let line = self.line;
        // An odd number of quotes leaves a cell open.
        while !text.matches('"').count().is_multiple_of(2) {
            if self.read_line(&mut text)? == 0 {
                return Err(Fault::OpenQuote.at(line));
            }
        }
        let cells = cells(text.trim_end_matches(['\n', '\r'])).map_err(|fault| fault.at(line))?;
        Ok(Some((line, cells)))
    }

    fn read_line(&mut self, text: &mut String) -> Result<usize, CsvError> {
        self.line += 1;
        self.input.read_line(text).map_err(|error| Fault::Io(error).at(self.line))
    }
}

/// The cells of a record. A quote inside a cell that does not begin with one is text.
fn cells(mut text: &str) -> Result<Vec<String>, Fault> {
    let mut cells = Vec::new();
    loop {
        let rest = if let Some(mut quoted) = text.strip_prefix('"') {
            let mut cell = String::new();
            let rest = loop {
                let (part, rest) = quoted.split_once('"').ok_or(Fault::OpenQuote)?;
                cell.push_str(part);
                match rest.strip_prefix('"') {
                    Some(rest) => quoted = rest,
                    None => break rest,
                }
                cell.push('"');
            };
            cells.push(cell);
            rest
        } else {
            let end = text.find(',').unwrap_or(text.len());
            cells.push(text[..end].to_owned());
            &text[end..]
        };
        match rest.chars().next() {
            None => return Ok(cells),
            Some(',') => text = &rest[1..],
            Some(found) => return Err(Fault::AfterQuote { cell: cells.len(), found }),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::csv::Csv;

    fn rows(text: &str) -> Result<Vec<(usize, Vec<String>)>, CsvError> {
        let mut reader = CsvReader::new(text.as_bytes())?;
        let mut rows = Vec::new();
        while let Some(row) = reader.next()? {
            rows.push((row.line, row.cells));
        }
        Ok(rows)
    }

    #[test]
    fn rows_have_their_lines() {
        let text = "\u{feff}a, b\r\n\r\n1,\"x\r\ny\"\r\n\"\",\"say \"\"no\"\"\"\n";
        let row = |line, cells: [&str; 2]| (line, cells.map(str::to_owned).to_vec());
        assert_eq!(rows(text).unwrap(), [row(3, ["1", "x\r\ny"]), row(5, ["", "say \"no\""])]);
        let reader = CsvReader::new(text.as_bytes()).unwrap();
        assert_eq!((reader.column("a").unwrap(), reader.column("b").unwrap()), (0, 1));
    }

    #[test]
    fn what_is_wrong_is_named() {
        let of = |error: CsvError| error.in_file(Path::new("t.csv")).to_string();
        for (text, reason) in [
            ("", "t.csv: no rows"),
            ("\n \n", "t.csv: no rows"),
            ("a,b\n1,2\n3\n", "t.csv:3: found 1 cells, expected 2"),
            ("a\n1\n\"2\n3\n", "t.csv:3: a quoted cell does not end"),
            ("a,b\n1,\"2\"3\n", "t.csv:2: found '3' after quoted cell 2"),
            ("a\n\"2\"x\"\"\n", "t.csv:2: found 'x' after quoted cell 1"),
        ] {
            let error = of(rows(text).unwrap_err());
            assert!(error.contains(reason), "{error}");
        }
        let reader = CsvReader::new("a,b,a\n".as_bytes()).unwrap();
        assert_eq!(of(reader.column("a").unwrap_err()), "t.csv: two columns are called 'a'");
        let missing = of(reader.column("c").unwrap_err());
        assert_eq!(missing, "t.csv: no column is called 'c', the columns are a, b, a");
    }

    proptest! {
        /// What is written is read back.
        #[test]
        fn it_reads_what_is_written(cells in prop::collection::vec("[a-c\",\n\r é]{0,6}", 4)) {
            let mut csv = Csv::new(&["w", "x", "y", "z"]);
            csv.push(&cells);
            csv.push(&["1", "2", "3", "4"]);
            let text = String::from_utf8(csv.into_bytes()).unwrap();
            let found = rows(&text).unwrap();
            prop_assert_eq!(&found[0].1, &cells);
            prop_assert_eq!(found[1].1.concat(), "1234");
        }

        #[test]
        fn no_text_panics(text in "[a1\",\n\r]{0,40}") {
            let _ = rows(&text);
        }
    }
}
