//! Computes the features of one structure after another, and refuses structures for which they mean nothing.

use std::sync::Arc;

use atoms::{NeighbourList, PotentialError, Structure, StructureError, shortest_distance};
use calm::Pair;
use potentials::grace::{Grace, GraceModel};

/// Shortest accepted distance, Å; the shortest bond, that of H₂, is 0.74 Å. Label programs apply the same limit.
const MIN_DISTANCE: f64 = 0.4;

/// A model with work arrays.
pub struct FeatureCalculator {
    pub grace: Grace,
    pub neighbours: NeighbourList,
}

/// Why a structure has no features.
#[derive(Debug, thiserror::Error)]
pub enum FeatureError {
    /// An invalid structure.
    #[error(transparent)]
    Structure(#[from] StructureError),
    /// An element that the model does not support.
    #[error(transparent)]
    Potential(#[from] PotentialError),
    /// Overlapping atoms.
    #[error("the energy is {0} eV: do atoms overlap?")]
    NotFinite(f64),
    /// Atoms so close that energy and grades of a model are arbitrary.
    #[error(
        "atoms {0} and {1} are {2:.3} Å apart; expected at least {MIN_DISTANCE} Å: grades are meaningless"
    )]
    Coincident(usize, usize, f64),
}

impl FeatureCalculator {
    /// Computes on the calling thread.
    pub fn new(model: Arc<GraceModel>) -> Self {
        Self { neighbours: NeighbourList::new(model.cutoff(), 0.0), grace: Grace::new(model) }
    }

    /// Computes energies and features of `structure`, which [`Grace`] then has. Returns the element index of each atom.
    pub fn compute(&mut self, structure: &Structure) -> Result<Vec<usize>, FeatureError> {
        let elements = self.grace.model().element_indices(&structure.species)?;
        self.neighbours.update(structure)?;
        let shortest = shortest_distance(structure, &self.neighbours);
        if let Some((i, j, distance)) = shortest.filter(|(_, _, distance)| *distance < MIN_DISTANCE) {
            return Err(FeatureError::Coincident(i, j, distance));
        }
        self.grace.forward(structure, &self.neighbours)?;
        let energy: f64 = self.grace.atomic_energies().iter().sum();
        if !energy.is_finite() {
            return Err(FeatureError::NotFinite(energy));
        }
        Ok(elements)
    }

    /// Directed bonds of the last structure within the pair cutoffs, to average over neighbourhoods. `elements` are those that
    /// [`Self::compute`] returned.
    pub fn pairs(&self, structure: &Structure, elements: &[usize]) -> Vec<Pair> {
        let (model, mut bonds, mut pairs) = (self.grace.model(), Vec::new(), Vec::new());
        for (i, centre) in elements.iter().enumerate() {
            self.neighbours.bonds_within(structure, i, model.cutoff(), &mut bonds);
            pairs.extend(bonds.iter().map(|bond| {
                let j = bond.atom as usize;
                Pair::new(i, j, bond.r, model.pair_cutoff(*centre, elements[j]))
            }));
        }
        pairs
    }
}
