//! A GRACE model: immutable weights, shared between threads.

use std::path::Path;
use std::sync::Arc;

use atoms::{PotentialError, Species};
use npz::Archive;

use super::builder::ModelParts;
use super::error::GraceError;
use super::network::{AnyNetwork, Network};
use super::precision::Precision;
use super::projection::Projection;
use super::radial::RadialPath;
use super::symmetry::require_invariance;
use super::vector::Vector;
use super::{one_layer, three_layers, two_layers};

/// The number of message-passing layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Architecture {
    /// GRACE-1L
    OneLayer,
    /// GRACE-2L
    TwoLayer,
    /// GRACE-3L
    ThreeLayer,
}

impl Architecture {
    /// The number of layers in words.
    pub(super) fn number_of_layers(self) -> &'static str {
        match self {
            Self::OneLayer => "one",
            Self::TwoLayer => "two",
            Self::ThreeLayer => "three",
        }
    }
}

impl std::fmt::Display for Architecture {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Self::OneLayer => "GRACE-1L",
            Self::TwoLayer => "GRACE-2L",
            Self::ThreeLayer => "GRACE-3L",
        })
    }
}

/// A summary of a model.
#[derive(Clone, Debug, PartialEq)]
pub struct GraceDescription {
    /// Number of layers.
    pub architecture: Architecture,
    /// Symbols, in the order of element indices.
    pub elements: Vec<Species>,
    /// The largest cutoff, Å. Information travels as many cutoffs as there are layers.
    pub cutoff: f64,
    /// Whether cutoffs depend on the pair of elements.
    pub pair_cutoffs: bool,
    /// The highest order l of the spherical harmonics.
    pub lmax: usize,
    /// Number of Chebyshev polynomials.
    pub radial_basis_size: usize,
    /// Radial channels of the first layer.
    pub channels: usize,
    /// The tensors in the energy, layer by layer: A, AA, AAA, AAAA.
    pub basis_functions: Vec<String>,
    /// D_basis, the number of invariants.
    pub basis_dimension: usize,
    /// D, the dimension of z; 0 without feature arrays.
    pub feature_dimension: usize,
    /// Number of trained weights.
    pub weights: usize,
    /// Tables of radial functions: number of intervals, and the measured relative errors of values and
    /// derivatives; empty on the exact path.
    pub radial_tables: Vec<(usize, [f64; 2])>,
}

/// A GRACE model read from a `kokkos.npz` export.
#[derive(Clone, Debug)]
pub struct GraceModel {
    pub(super) network: AnyNetwork,
    /// r_c for centre and neighbour element, `[n_elements²]`, Å.
    pair_cutoffs: Vec<f64>,
    description: GraceDescription,
}

impl GraceModel {
    /// Reads a model for double precision with tabulated radial functions.
    ///
    /// # Errors
    /// With file, array, what was found and what was expected.
    pub fn load(path: &Path) -> Result<Self, GraceError> {
        Self::load_with(path, RadialPath::default())
    }

    /// Reads a model with this evaluation of radial functions.
    ///
    /// # Errors
    /// As [`GraceModel::load`].
    pub fn load_with(path: &Path, radial: RadialPath) -> Result<Self, GraceError> {
        Self::load_in(path, Precision::Double, radial)
    }

    /// Reads a model for this precision.
    ///
    /// # Errors
    /// As [`GraceModel::load`].
    pub fn load_in(path: &Path, precision: Precision, radial: RadialPath) -> Result<Self, GraceError> {
        let archive = Archive::open(path)?;
        match precision {
            Precision::Double => Self::read(&archive, radial, AnyNetwork::Double),
            Precision::Mixed => Self::read(&archive, radial, AnyNetwork::Mixed),
        }
    }

    fn read<V: Vector>(
        archive: &Archive,
        path: RadialPath,
        any: fn(Arc<Network<V>>) -> AnyNetwork,
    ) -> Result<Self, GraceError> {
        let architecture = detect(archive);
        let ModelParts { network, pair_cutoffs, description } = match architecture {
            Architecture::OneLayer => one_layer::read(archive, path)?,
            Architecture::TwoLayer => two_layers::read(archive, path)?,
            Architecture::ThreeLayer => three_layers::read(archive, path)?,
        };
        let model = Self { network: any(Arc::new(network)), pair_cutoffs, description };
        match architecture {
            Architecture::OneLayer => Ok(model),
            _ => require_invariance(archive, model),
        }
    }

    /// The precision of the evaluation.
    pub fn precision(&self) -> Precision {
        self.network.precision()
    }

    /// The supported elements, in the order of element indices.
    pub fn elements(&self) -> &[Species] {
        &self.description.elements
    }

    /// The largest cutoff, Å.
    pub fn cutoff(&self) -> f64 {
        self.description.cutoff
    }

    /// The cutoff for the element indices (centre, neighbour), Å.
    ///
    /// # Panics
    /// If an index is out of range.
    pub fn pair_cutoff(&self, centre: usize, neighbour: usize) -> f64 {
        let n = self.elements().len();
        assert!(centre < n && neighbour < n, "element index out of range");
        self.pair_cutoffs[centre * n + neighbour]
    }

    /// D, the dimension of z; 0 for a model without feature arrays.
    pub fn feature_dimension(&self) -> usize {
        self.projection().map_or(0, Projection::feature_dimension)
    }

    /// The feature map, if the file has one.
    pub fn projection(&self) -> Option<&Projection> {
        self.network.projection()
    }

    /// A summary of the model.
    pub fn description(&self) -> &GraceDescription {
        &self.description
    }

    /// The element index of each species, `[n]`.
    ///
    /// # Errors
    /// [`PotentialError::Species`] for an element that the model does not support.
    pub fn element_indices(&self, species: &[Species]) -> Result<Vec<usize>, PotentialError> {
        let mut indices = Vec::new();
        self.write_element_indices(species, &mut indices)?;
        Ok(indices)
    }

    pub(super) fn write_element_indices(
        &self,
        species: &[Species],
        indices: &mut Vec<usize>,
    ) -> Result<(), PotentialError> {
        indices.clear();
        for (atom, species) in species.iter().enumerate() {
            match self.elements().iter().position(|known| known == species) {
                Some(index) => indices.push(index),
                None => {
                    indices.clear();
                    let known: Vec<&str> = self.elements().iter().map(|known| known.symbol()).collect();
                    return Err(PotentialError::Species { atom, species: *species, known: known.join(", ") });
                }
            }
        }
        Ok(())
    }
}

/// Detects the depth by the lists of single-particle basis functions that only deeper models have.
fn detect(archive: &Archive) -> Architecture {
    if archive.contains("spbf_names") {
        Architecture::ThreeLayer
    } else if archive.contains("spb_names") {
        Architecture::TwoLayer
    } else {
        Architecture::OneLayer
    }
}
