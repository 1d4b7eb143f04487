//! What can be wrong with a dump.

use crate::species::UnknownSpecies;
use crate::structure::StructureError;

/// An error with its line.
#[derive(Debug, thiserror::Error)]
#[error("line {line}: {kind}")]
pub struct DumpError {
    /// Line of the file, from 1.
    pub line: usize,
    /// What is wrong.
    #[source]
    pub kind: DumpErrorKind,
}

/// What is wrong with a line.
#[derive(Debug, thiserror::Error)]
pub enum DumpErrorKind {
    /// The stream cannot be read.
    #[error("cannot be read: {0}")]
    Io(std::io::Error),
    /// The line is not text.
    #[error("found bytes that are not text, expected a text dump of LAMMPS; is this a binary dump?")]
    Encoding,
    /// The stream ends too early.
    #[error("the file ends here, expected {0}")]
    End(&'static str),
    /// A line has the wrong format.
    #[error("found '{found}', expected {expected}")]
    Line {
        /// The line.
        found: String,
        /// The expected content.
        expected: &'static str,
    },
    /// The atoms come before a section that they need.
    #[error("the snapshot has no section {0} before its atoms")]
    NoSection(&'static str),
    /// The columns have no position.
    #[error("found the columns '{0}', expected x y z, xu yu zu, xs ys zs or xsu ysu zsu among them")]
    NoPosition(String),
    /// The elements are unknown.
    #[error(
        "the dump has no column 'element': give the elements of its atom types in order, such as --dump-elements Al,Mo"
    )]
    NoElements,
    /// There are neither elements nor types.
    #[error("found the columns '{0}', expected 'element' or 'type' among them")]
    NoType(String),
    /// An atom type without an element.
    #[error("found atom type {found}, but elements are given for types 1 to {given}")]
    Type {
        /// The type.
        found: String,
        /// Number of elements given.
        given: usize,
    },
    /// Two atoms have the same id.
    #[error("two atoms have the id {0}")]
    RepeatedId(i64),
    /// An unknown element symbol.
    #[error(transparent)]
    Species(#[from] UnknownSpecies),
    /// The structure is invalid.
    #[error(transparent)]
    Structure(#[from] StructureError),
    /// An error of the whole snapshot.
    #[error("{fault}")]
    Snapshot {
        /// Line at which the snapshot starts.
        line: usize,
        /// What is wrong.
        fault: Box<DumpErrorKind>,
    },
}

impl DumpErrorKind {
    /// A line of the wrong format.
    pub(super) fn line(found: &str, expected: &'static str) -> Self {
        Self::Line { found: found.trim().chars().take(60).collect(), expected }
    }

    /// An error of the whole snapshot that starts at `line`.
    pub(super) fn of_snapshot(self, line: usize) -> Self {
        Self::Snapshot { line, fault: Box::new(self) }
    }

    /// The error, found while line `number` was read.
    pub(super) fn at(self, number: usize) -> DumpError {
        match self {
            Self::Snapshot { line, fault } => DumpError { line, kind: *fault },
            kind => DumpError { line: number, kind },
        }
    }
}
