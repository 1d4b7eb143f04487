//! Extended XYZ, read and written as ASE does (`ase.io.extxyz`).
//!
//! A frame is a line with the number of atoms, a comment line of `key=value` pairs and a line per
//! atom whose columns the key `Properties` describes. What this reader does otherwise than ASE:
//! a 6-component `stress` or `virial` is taken (Voigt: xx yy zz yz xz xy), a bare `[[…],[…]]` is a
//! matrix, frames after a blank line are read, and what contradicts itself is an error (a key given
//! twice with different values, more fields than `Properties` tell of, an unclosed quote).
//!
//! Real numbers are written with the fewest digits that give the same bits back.
//!
//! The kept crates do not do this job: `extxyz` 0.2 only reads, knows no escapes, and its errors
//! have no line (a column count beyond 64 bits ends in a panic).

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
pub use labels::{LabelError, LabelKeys, Labels};
pub use read::Reader;
pub use value::Value;
pub use write::{WriteError, write_frame};

/// One configuration with what the file tells of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Species, positions, cell (zero where the file has none) and periodicity.
    pub structure: Structure,
    /// What the comment line says beside `Lattice`, `Properties` and `pbc`, by key.
    pub info: BTreeMap<String, Value>,
    /// The columns beside species and positions, by the name they have in the file.
    pub arrays: BTreeMap<String, Column>,
    /// The line of the file where the frame starts, from 1; 0 for a frame that no file gave.
    pub line: usize,
}

impl From<Structure> for Frame {
    fn from(structure: Structure) -> Self {
        Self { structure, info: BTreeMap::new(), arrays: BTreeMap::new(), line: 0 }
    }
}

/// A quantity per atom, [n × width].
#[derive(Clone, Debug, PartialEq)]
pub struct Column {
    /// Entries per atom.
    pub width: usize,
    /// The entries, atom by atom.
    pub entries: ColumnData,
}

/// Entries of one type, [n · width].
#[derive(Clone, Debug, PartialEq)]
pub enum ColumnData {
    /// `R`
    Real(Vec<f64>),
    /// `I` (ASE reads 32 bits only)
    Int(Vec<i64>),
    /// `L`
    Bool(Vec<bool>),
    /// `S`, words without white space
    Text(Vec<String>),
}

impl ColumnData {
    /// Number of entries.
    pub fn len(&self) -> usize {
        match self {
            Self::Real(values) => values.len(),
            Self::Int(values) => values.len(),
            Self::Bool(values) => values.len(),
            Self::Text(values) => values.len(),
        }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

impl Column {
    /// A column of vectors, [n × 3].
    pub fn vectors(vectors: &[[f64; 3]]) -> Self {
        Self { width: 3, entries: ColumnData::Real(vectors.concat()) }
    }

    /// The entries as reals, if they are numbers.
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
