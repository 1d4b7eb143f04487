//! Reads and writes extended XYZ compatibly with ASE (`ase.io.extxyz`).
//!
//! A frame is a line with the number of atoms, a comment line of `key=value` pairs, and a line per atom whose
//! columns the key `Properties` describes. Differences from ASE: a 6-component `stress` or `virial` is accepted
//! (Voigt: xx yy zz yz xz xy); a bare `[[…],[…]]` is a matrix; frames after a blank line are read;
//! contradictions are errors (a key with two different values, more fields than in `Properties`, an unclosed
//! quote).
//!
//! Real numbers are written with the fewest digits that preserve their bits.
//!
//! No maintained crate fits: `extxyz` 0.2 only reads, does not support escapes, and its errors have no line
//! numbers (a column count beyond 64 bits panics).

mod comment;
mod error;
mod labels;
mod read;
mod table;
mod value;
mod write;

use std::collections::BTreeMap;

use crate::structure::Structure;

pub use error::{ExtxyzError, ExtxyzErrorKind};
pub use labels::{FrameLabels, LabelError, LabelKeys};
pub use read::ExtxyzReader;
pub use value::ExtxyzValue;
pub use write::{ExtxyzWriteError, write_frame};

/// A structure with the other data of its frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Species, positions, cell (zero where the file has none) and periodicity.
    pub structure: Structure,
    /// The keys of the comment line except `Lattice`, `Properties` and `pbc`.
    pub info: BTreeMap<String, ExtxyzValue>,
    /// The columns except species and positions, by their name in the file.
    pub arrays: BTreeMap<String, Column>,
    /// The line at which the frame starts, from 1; 0 if it did not come from a file.
    pub line: usize,
}

impl From<Structure> for Frame {
    fn from(structure: Structure) -> Self {
        Self { structure, info: BTreeMap::new(), arrays: BTreeMap::new(), line: 0 }
    }
}

/// A per-atom quantity, `[n × width]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Column {
    /// Values per atom.
    pub width: usize,
    /// The values, atom by atom.
    pub entries: ColumnData,
}

/// Values of one type, `[n · width]`.
#[derive(Clone, Debug, PartialEq)]
pub enum ColumnData {
    /// `R`
    Real(Vec<f64>),
    /// `I` (ASE reads 32 bits only)
    Int(Vec<i64>),
    /// `L`.
    Bool(Vec<bool>),
    /// `S`: words without white space.
    Text(Vec<String>),
}

impl ColumnData {
    /// Number of values.
    pub fn len(&self) -> usize {
        match self {
            Self::Real(values) => values.len(),
            Self::Int(values) => values.len(),
            Self::Bool(values) => values.len(),
            Self::Text(values) => values.len(),
        }
    }

    /// Whether there are no values.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

impl Column {
    /// A column of vectors, `[n × 3]`.
    pub fn vectors(vectors: &[[f64; 3]]) -> Self {
        Self { width: 3, entries: ColumnData::Real(vectors.concat()) }
    }

    /// A column of numbers, `[n]`.
    pub fn scalars(numbers: &[f64]) -> Self {
        Self { width: 1, entries: ColumnData::Real(numbers.to_vec()) }
    }

    /// The values as reals, if they are numbers.
    pub fn reals(&self) -> Option<Vec<f64>> {
        match &self.entries {
            ColumnData::Real(values) => Some(values.clone()),
            ColumnData::Int(values) => Some(values.iter().map(|value| *value as f64).collect()),
            ColumnData::Bool(_) | ColumnData::Text(_) => None,
        }
    }
}

#[cfg(test)]
mod tests;
