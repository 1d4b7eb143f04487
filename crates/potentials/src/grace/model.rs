//! A GRACE model: weights that never change, shared between threads.

use std::path::Path;

use atoms::{PotentialError, Species};
use npz::Archive;

use super::error::GraceError;
use super::layer::Layer;
use super::matrix::Lanes;
use super::projection::Projection;
use super::radial::RadialPath;
use super::readout::Readout;
use super::symmetry::require_invariance;
use super::{one_layer, three_layers, two_layers};

/// How many message-passing layers a model has.
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
    /// In words.
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

/// What a model is made of, for people.
#[derive(Clone, Debug, PartialEq)]
pub struct GraceDescription {
    /// Number of layers.
    pub architecture: Architecture,
    /// Symbols, in the order of element indices.
    pub elements: Vec<Species>,
    /// The largest cutoff, Å; messages carry further, as many times as there are layers.
    pub cutoff: f64,
    /// Whether pairs of elements have cutoffs of their own.
    pub pair_cutoffs: bool,
    /// The highest order l of the spherical harmonics.
    pub lmax: usize,
    /// Chebyshev polynomials.
    pub radial_basis_size: usize,
    /// Radial channels of the first layer.
    pub channels: usize,
    /// The tensors the energy is made of, layer after layer: A, AA, AAA, AAAA.
    pub basis_functions: Vec<String>,
    /// D_basis, the number of invariants.
    pub basis_dimension: usize,
    /// D, the dimension of z; 0 without feature arrays.
    pub feature_dimension: usize,
    /// Number of trained weights.
    pub weights: usize,
    /// Tables of radial functions: number of intervals, and the measured errors of values and of
    /// derivatives relative to the largest of each; empty on the exact path.
    pub radial_tables: Vec<(usize, [f64; 2])>,
}

/// A GRACE model read from a `kokkos.npz` export, in double precision.
#[derive(Clone, Debug)]
pub struct GraceModel {
    pub(super) elements: Vec<Species>,
    pub(super) layers: Vec<Layer>,
    pub(super) readout: Readout,
    pub(super) projection: Option<Projection>,
    pub(super) description: GraceDescription,
}

impl GraceModel {
    /// Reads a model, radial functions tabulated.
    ///
    /// # Errors
    /// Names the file, the array, what was found and what was expected.
    pub fn load(path: &Path) -> Result<Self, GraceError> {
        Self::load_with(path, RadialPath::default())
    }

    /// Reads a model; `radial` says how its radial functions are evaluated.
    ///
    /// # Errors
    /// As [`GraceModel::load`].
    pub fn load_with(path: &Path, radial: RadialPath) -> Result<Self, GraceError> {
        let archive = Archive::open(path)?;
        match detect(&archive) {
            Architecture::OneLayer => one_layer::read(&archive, radial),
            Architecture::TwoLayer => require_invariance(&archive, two_layers::read(&archive, radial)?),
            Architecture::ThreeLayer => require_invariance(&archive, three_layers::read(&archive, radial)?),
        }
    }

    /// The elements it knows; an element's index is its position.
    pub fn elements(&self) -> &[Species] {
        &self.elements
    }

    /// The largest cutoff, Å.
    pub fn cutoff(&self) -> f64 {
        self.layers.iter().map(|layer| layer.radial.largest_cutoff()).fold(0.0, f64::max)
    }

    /// The cutoff of a pair by element indices (centre, neighbour), Å.
    ///
    /// # Panics
    /// If an index is not below the number of elements.
    pub fn pair_cutoff(&self, centre: usize, neighbour: usize) -> f64 {
        assert!(
            centre < self.elements.len() && neighbour < self.elements.len(),
            "element index out of range"
        );
        let cutoffs =
            self.layers.iter().map(|layer| layer.radial.cutoff(layer.radial.pair(centre, neighbour)));
        cutoffs.fold(0.0, f64::max)
    }

    /// What an atom takes on the longest tape, bytes.
    pub(super) fn tape_bytes(&self) -> usize {
        let lanes = self.layers.iter().map(|layer| layer.used.lanes()).max();
        lanes.unwrap_or(0) * size_of::<Lanes>()
    }

    /// D, the dimension of z; 0 for a model without feature arrays.
    pub fn feature_dimension(&self) -> usize {
        self.projection.as_ref().map_or(0, Projection::feature_dimension)
    }

    /// The feature map, if the file holds one.
    pub fn projection(&self) -> Option<&Projection> {
        self.projection.as_ref()
    }

    /// What the model is made of.
    pub fn description(&self) -> &GraceDescription {
        &self.description
    }

    /// The element index of each species, [n].
    ///
    /// # Errors
    /// [`PotentialError::Species`] for an element the model does not know.
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
            match self.elements.iter().position(|known| known == species) {
                Some(index) => indices.push(index),
                None => {
                    indices.clear();
                    let known: Vec<&str> = self.elements.iter().map(|known| known.symbol()).collect();
                    return Err(PotentialError::Species { atom, species: *species, known: known.join(", ") });
                }
            }
        }
        Ok(())
    }
}

/// The lists of single-particle basis functions that only deeper models have.
fn detect(archive: &Archive) -> Architecture {
    if archive.contains("spbf_names") {
        Architecture::ThreeLayer
    } else if archive.contains("spb_names") {
        Architecture::TwoLayer
    } else {
        Architecture::OneLayer
    }
}
