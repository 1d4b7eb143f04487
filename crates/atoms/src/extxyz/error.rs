//! Errors of the extended XYZ format.

use crate::species::UnknownSpecies;
use crate::structure::StructureError;

/// An error with its line.
#[derive(Debug, thiserror::Error)]
#[error("line {line}: {kind}")]
pub struct ExtxyzError {
    /// Line of the file, from 1.
    pub line: usize,
    /// What is wrong.
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
    /// The first line of a frame is not a number of atoms.
    #[error("found '{found}', expected the number of atoms of a frame")]
    Count {
        /// The line.
        found: String,
    },
    /// The stream ends inside a frame.
    #[error("the file ends after {found} of the {expected} atoms of the frame at line {start}")]
    Truncated {
        /// Atoms read.
        found: u64,
        /// Atoms stated in the header.
        expected: u64,
        /// Where the frame starts.
        start: usize,
    },
    /// A quote or bracket in the comment line is not closed.
    #[error("column {column}: {delimiter} is opened and never closed")]
    Unclosed {
        /// Where it opens, from 1.
        column: usize,
        /// The opening character.
        delimiter: char,
    },
    /// An equals sign in the comment line has no key.
    #[error("column {column}: found '=', expected a key before it")]
    NoKey {
        /// Where it is, from 1.
        column: usize,
    },
    /// A key of the comment line or a column occurs twice.
    #[error("{key} is given twice, expected one value")]
    Repeated {
        /// The key.
        key: String,
    },
    /// A key of the comment line has an invalid value.
    #[error("{key} is '{found}', expected {expected}")]
    Key {
        /// The key.
        key: String,
        /// Its value.
        found: String,
        /// The valid values.
        expected: &'static str,
    },
    /// An atom line has the wrong number of fields.
    #[error("found {found} fields, expected {expected} (see Properties)")]
    Fields {
        /// Fields of the line.
        found: usize,
        /// Fields that `Properties` describes.
        expected: usize,
    },
    /// A field of an atom line is invalid.
    #[error("field {field} ({name}): found '{found}', expected {expected}")]
    Field {
        /// Which field, from 1.
        field: usize,
        /// Name of its column.
        name: String,
        /// The field.
        found: String,
        /// The valid values.
        expected: &'static str,
    },
    /// An unknown element in an atom line.
    #[error("field {field}: {source}")]
    Species {
        /// Which field, from 1.
        field: usize,
        /// The unknown element.
        source: UnknownSpecies,
    },
    /// The structure is invalid.
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

/// The start of a text that may be long.
pub(super) fn excerpt(text: &str) -> String {
    let start: String = text.trim().chars().take(60).collect();
    if start.len() < text.trim().len() { start + "…" } else { start }
}
