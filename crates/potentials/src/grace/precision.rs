//! In which precision a model is evaluated.

use std::fmt;

use serde::{Deserialize, Serialize};

/// How many digits the passes over atoms have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// Double precision throughout.
    #[default]
    Double,
    /// Single precision for all that is done for each channel: weights, tables of radial functions (made and checked in
    /// double precision, then rounded), densities, products, messages, their cotangents, and what the projection takes.
    /// Double precision for positions, bonds and the place of a distance in its table, for the sums of forces, virials and
    /// energies over atoms and bonds, for norms, activations, scale and shifts, and for features as they are given out. Twice
    /// as many numbers go through a vector register and a cache.
    Mixed,
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Double => "double",
            Self::Mixed => "mixed",
        })
    }
}
