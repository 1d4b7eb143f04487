//! What a server says of its model.

use std::collections::BTreeMap;

use atoms::Species;
use serde::{Deserialize, Serialize};

/// The version of the protocol.
pub(crate) const PROTOCOL: u32 = 1;

/// Answer to `hello`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelDescription {
    /// Version of the protocol.
    pub protocol: u32,
    /// Name of the adapter.
    pub adapter: String,
    /// Versions of Python and of the packages that matter.
    pub versions: BTreeMap<String, String>,
    /// Where the model is evaluated.
    pub device: String,
    /// Chemical symbols, in the order of the element indices.
    pub elements: Vec<String>,
    /// Cutoff by pair of element indices, Å; 0 for a model that needs no bonds.
    pub cutoffs: Vec<Vec<f64>>,
    /// The features.
    pub features: RawFeatures,
    /// `double` or `single`.
    pub precision: String,
    /// Whether the program is compiled for each shape of a batch.
    pub padding: bool,
    /// Whether the adapter can leave forces out of an evaluation, and so save their gradient.
    #[serde(default)]
    pub evaluates_without_forces: bool,
    /// Hash of the model, of the adapter and of the definition of its features.
    pub identity: String,
    /// Largest number of structures of a batch that the adapter takes.
    #[serde(default)]
    pub max_structures: Option<u32>,
}

/// The features of an adapter.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RawFeatures {
    /// What they are.
    pub form: AdapterFeatures,
    /// Number of features of an atom.
    pub dimension: usize,
    /// Columns of each layer.
    pub blocks: Vec<usize>,
}

/// What the features of an adapter are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AdapterFeatures {
    /// As they are graded.
    Final,
    /// Invariants, which calmwalk normalises and projects.
    Raw,
    /// There are none: the model has energies and forces only.
    None,
}

impl ModelDescription {
    /// Checks what the program relies on, and returns the elements.
    ///
    /// # Errors
    /// What is wrong with the answer.
    pub(crate) fn check(&self) -> Result<Vec<Species>, String> {
        if self.protocol != PROTOCOL {
            return Err(format!(
                "protocol {}; expected {PROTOCOL}: use the package of this calmwalk",
                self.protocol
            ));
        }
        let element = |symbol: &String| {
            symbol.parse::<Species>().map_err(|_| format!("elements: '{symbol}' is no chemical symbol"))
        };
        let elements = self.elements.iter().map(element).collect::<Result<Vec<_>, _>>()?;
        let count = elements.len();
        let repeated = (1..count).find(|k| elements[..*k].contains(&elements[*k]));
        if let Some(repeated) = repeated {
            return Err(format!("elements: {} is there twice", elements[repeated]));
        }
        let square = self.cutoffs.len() == count && self.cutoffs.iter().all(|row| row.len() == count);
        if count == 0 || !square {
            return Err(format!("cutoffs: not a row and a column for each of {count} elements"));
        }
        if let Some(wrong) =
            self.cutoffs.iter().flatten().find(|cutoff| !(cutoff.is_finite() && **cutoff >= 0.0))
        {
            return Err(format!("cutoffs: {wrong}; expected a number of Å"));
        }
        let RawFeatures { form, dimension, blocks } = &self.features;
        let columns: usize = blocks.iter().sum();
        let has_features = *form != AdapterFeatures::None;
        if has_features && (columns != *dimension || columns == 0 || blocks.contains(&0)) {
            return Err(format!("features: {dimension} features in blocks of {blocks:?}"));
        }
        Ok(elements)
    }

    /// The largest cutoff, Å.
    pub fn cutoff(&self) -> f64 {
        self.cutoffs.iter().flatten().copied().fold(0.0, f64::max)
    }
}
