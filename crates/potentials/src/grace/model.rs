//! A GRACE model: immutable weights, shared between threads.

use atoms::{PotentialError, Species};

use super::description::GraceDescription;
use super::error::UnfitProjection;
use super::network::AnyNetwork;
use super::precision::Precision;
use super::projection::{FeatureForm, GraceProjection};

/// A GRACE model read from a `kokkos.npz` export.
#[derive(Clone, Debug)]
pub struct GraceModel {
    pub(super) network: AnyNetwork,
    /// r_c for centre and neighbour element, `[n_elements²]`, Å.
    pub(super) pair_cutoffs: Vec<f64>,
    pub(super) description: GraceDescription,
}

impl GraceModel {
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
        self.projection().map_or(0, GraceProjection::feature_dimension)
    }

    /// The model with this projection of its features, in place of its own if it has one.
    ///
    /// # Errors
    /// A matrix that has not D_basis rows; another number of layers.
    pub fn with_projection(mut self, projection: GraceProjection) -> Result<Self, UnfitProjection> {
        let fits = |what, found, expected| {
            if found == expected { Ok(()) } else { Err(UnfitProjection { what, found, expected }) }
        };
        let (basis, layers) = (self.description.basis_dimension, self.description.architecture.layers());
        fits("layers", projection.layers, layers)?;
        fits("numbers in its matrix", projection.matrix.len(), basis * projection.dimension)?;
        self.description.feature_dimension = projection.feature_dimension();
        self.network.set_projection(projection);
        Ok(self)
    }

    /// The feature map, if the model has one.
    pub fn projection(&self) -> Option<&GraceProjection> {
        self.network.projection()
    }

    /// D_ρ, the number of densities that the readout reads, the one that counts linearly included: the hidden layer and the energy of an
    /// atom are functions of them.
    pub fn density_dimension(&self) -> usize {
        self.network.density_dimension()
    }

    /// D_h, the number of features of [`super::Grace::hidden_layer`].
    pub fn hidden_dimension(&self) -> usize {
        self.network.hidden_dimension()
    }

    /// The same model with other features from the same projection matrix R. `None` without feature arrays.
    pub fn with_features(&self, form: FeatureForm) -> Option<Self> {
        self.projection()?;
        let mut model = self.clone();
        model.network = model.network.with_features(form);
        model.description.feature_dimension = model.feature_dimension();
        Some(model)
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
