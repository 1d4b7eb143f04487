//! Reads the text files in which interatomic potentials are published.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// Why a potential file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum PotentialFileError {
    /// The file cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The file has an invalid line.
    #[error("{}, line {line}: found {found}, expected {expected}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// Line number from 1.
        line: usize,
        /// What the line has.
        found: String,
        /// What it should have.
        expected: String,
    },
}

/// A potential file in memory.
pub(crate) struct PotentialFile {
    path: PathBuf,
    text: String,
}

impl PotentialFile {
    /// Reads the file. Comments may be in any encoding.
    pub(crate) fn open(path: &Path) -> Result<Self, PotentialFileError> {
        let bytes =
            fs::read(path).map_err(|source| PotentialFileError::Read { path: path.to_owned(), source })?;
        Ok(Self { path: path.to_owned(), text: String::from_utf8_lossy(&bytes).into_owned() })
    }

    /// Its lines, from the start.
    pub(crate) fn lines(&self) -> Lines<'_> {
        Lines { path: &self.path, lines: self.text.lines(), number: 0 }
    }
}

/// A cursor in a potential file.
pub(crate) struct Lines<'a> {
    path: &'a Path,
    lines: std::str::Lines<'a>,
    number: usize,
}

impl<'a> Lines<'a> {
    /// Number of the line read last, from 1.
    pub(crate) fn number(&self) -> usize {
        self.number
    }

    /// The next line, or `None` at the end of the file.
    pub(crate) fn next(&mut self) -> Option<&'a str> {
        let line = self.lines.next()?;
        self.number += 1;
        Some(line)
    }

    /// The next line, which must hold `expected`.
    pub(crate) fn require(&mut self, expected: &str) -> Result<&'a str, PotentialFileError> {
        self.next().ok_or_else(|| self.error("the end of the file", expected))
    }

    /// The `index`-th of `tokens` as a finite number.
    pub(crate) fn number_at(
        &self,
        tokens: &[&str],
        index: usize,
        expected: &str,
    ) -> Result<f64, PotentialFileError> {
        let token = tokens.get(index).ok_or_else(|| self.error("the end of the line", expected))?;
        self.parse(token, expected)
    }

    /// `token` as a finite number.
    pub(crate) fn parse(&self, token: &str, expected: &str) -> Result<f64, PotentialFileError> {
        match token.parse::<f64>() {
            Ok(value) if value.is_finite() => Ok(value),
            _ => Err(self.error(format!("'{token}'"), expected)),
        }
    }

    /// `count` numbers from the following lines; the last of them must end its line.
    pub(crate) fn values(&mut self, count: usize, what: &str) -> Result<Vec<f64>, PotentialFileError> {
        let mut values = Vec::new();
        while values.len() < count {
            let Some(line) = self.next() else {
                return Err(self.error(
                    format!("the end of the file after {} of {count} values", values.len()),
                    format!("{count} values of {what}"),
                ));
            };
            for token in line.split_whitespace() {
                values.push(self.parse(token, what)?);
            }
        }
        if values.len() > count {
            return Err(self.error(
                format!("{} or more values of {what}", values.len()),
                format!("{count}, the last at the end of its line"),
            ));
        }
        Ok(values)
    }

    /// An error at the line read last.
    pub(crate) fn error(&self, found: impl Into<String>, expected: impl Into<String>) -> PotentialFileError {
        self.error_at(self.number, found, expected)
    }

    /// An error at a line read before.
    pub(crate) fn error_at(
        &self,
        line: usize,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> PotentialFileError {
        PotentialFileError::Content {
            path: self.path.to_owned(),
            line,
            found: found.into(),
            expected: expected.into(),
        }
    }
}
