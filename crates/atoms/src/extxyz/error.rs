//! What can be wrong with a file.

use crate::species::UnknownSpecies;
use crate::structure::StructureError;

/// What is wrong with a file, and where.
#[derive(Debug, thiserror::Error)]
#[error("line {line}: {kind}")]
pub struct ExtxyzError {
    /// Line of the file, from 1.
    pub line: usize,
    /// What is wrong with it.
    #[source]
    pub kind: ExtxyzErrorKind,
}

/// What is wrong with a line.
#[derive(Debug, thiserror::Error)]
pub enum ExtxyzErrorKind {
    /// The stream cannot be read.
    #[error("cannot be read: {0}")]
    Io(std::io::Error),
    /// Not UTF-8.
    #[error("found bytes that are not text, expected UTF-8")]
    Encoding,
    /// The first line of a frame.
    #[error("found '{found}', expected the number of atoms of a frame")]
    Count {
        /// The line.
        found: String,
    },
    /// The stream ends within a frame.
    #[error("the file ends after {found} of the {expected} atoms of the frame at line {start}")]
    Truncated {
        /// Atoms read.
        found: u64,
        /// Atoms announced.
        expected: u64,
        /// Where the frame starts.
        start: usize,
    },
    /// A quote or bracket of the comment line.
    #[error("column {column}: {delimiter} is opened and never closed")]
    Unclosed {
        /// Where it is opened, from 1.
        column: usize,
        /// The opening character.
        delimiter: char,
    },
    /// An equals sign of the comment line.
    #[error("column {column}: found '=', expected a key before it")]
    NoKey {
        /// Where it stands, from 1.
        column: usize,
    },
    /// A key of the comment line, or a column, given twice.
    #[error("{key} is given twice, expected one value")]
    Repeated {
        /// The key.
        key: String,
    },
    /// The value of a key of the comment line.
    #[error("{key} is '{found}', expected {expected}")]
    Key {
        /// The key.
        key: String,
        /// Its value.
        found: String,
        /// What it should be.
        expected: &'static str,
    },
    /// The number of fields of an atom line.
    #[error("found {found} fields, expected {expected} (see Properties)")]
    Fields {
        /// Fields of the line.
        found: usize,
        /// Fields that `Properties` describes.
        expected: usize,
    },
    /// A field of an atom line.
    #[error("field {field} ({name}): found '{found}', expected {expected}")]
    Field {
        /// Which field, from 1.
        field: usize,
        /// Name of its column.
        name: String,
        /// The field.
        found: String,
        /// What it should be.
        expected: &'static str,
    },
    /// The element of an atom line.
    #[error("field {field}: {source}")]
    Species {
        /// Which field, from 1.
        field: usize,
        /// The element.
        source: UnknownSpecies,
    },
    /// The frame as a whole.
    #[error(transparent)]
    Structure(#[from] StructureError),
}

impl ExtxyzErrorKind {
    pub(super) fn key(key: &str, found: &str, expected: &'static str) -> Self {
        Self::Key { key: excerpt(key), found: excerpt(found), expected }
    }

    pub(super) fn at(self, line: usize) -> ExtxyzError {
        ExtxyzError { line, kind: self }
    }
}

/// The beginning of a text that may be long.
pub(super) fn excerpt(text: &str) -> String {
    let start: String = text.trim().chars().take(60).collect();
    if start.len() < text.trim().len() { start + "…" } else { start }
}
