//! The precision of a model's evaluation.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The precision of the passes over atoms.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// Double precision throughout.
    #[default]
    Double,
    /// Single precision for all per-channel data: weights, tables of radial functions (built and checked in
    /// double precision, then rounded), densities, products, messages, their cotangents, and the input of the
    /// projection. Double precision for positions, bonds and the position of a distance in its table; for sums
    /// of forces, virials and energies over atoms and bonds; for norms, activations, scale and shifts; and for
    /// the features returned. Vector registers and caches hold twice as many numbers.
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
