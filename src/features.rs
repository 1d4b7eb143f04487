//! Computes the features of one structure after another, and refuses structures for which they mean nothing.

use std::sync::Arc;

use atoms::{Evaluation, NeighbourList, PotentialError, Structure, StructureError, shortest_distance};
use calm::{NeighbourWeights, Pair};
use potentials::grace::{GraceModel, HiddenLayerModel, PullBack, Threads};
use potentials::{ModelWithFeatures, PotentialWithFeatures};

/// Shortest accepted distance, Å; the shortest bond, that of H₂, is 0.74 Å. Label programs apply the same limit.
const MIN_DISTANCE: f64 = 0.4;

/// A model with work arrays.
pub struct FeatureCalculator {
    pub potential: Box<dyn PotentialWithFeatures>,
    pub neighbours: NeighbourList,
    /// Derivatives of the energy, which come with those of the features.
    of_energy: Evaluation,
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

impl FeatureError {
    /// Whether other structures may have features: what cannot be evaluated is the structure.
    pub fn is_of_structure(&self) -> bool {
        !matches!(self, Self::Potential(PotentialError::Unavailable(_) | PotentialError::Cutoff { .. }))
    }
}

impl FeatureCalculator {
    /// Computes on the calling thread.
    pub fn new(model: Arc<dyn ModelWithFeatures>) -> Self {
        Self {
            neighbours: NeighbourList::new(model.cutoff(), 0.0),
            potential: model.evaluator(Threads::default()),
            of_energy: Evaluation::default(),
        }
    }

    /// The same with the hidden layer of the readout as features.
    pub fn of_hidden_layer(model: Arc<GraceModel>) -> Self {
        Self::new(Arc::new(HiddenLayerModel(model)))
    }

    /// D
    pub fn dimension(&self) -> usize {
        self.potential.model().feature_dimension()
    }

    /// Features of the last structure, [n × D].
    pub fn features(&self) -> &[f64] {
        self.potential.features()
    }

    /// Computes energies and features of `structure`. Returns the element index of each atom.
    pub fn compute(&mut self, structure: &Structure) -> Result<Vec<usize>, FeatureError> {
        let elements = self.potential.model().element_indices(&structure.species)?;
        self.neighbours.update(structure)?;
        let shortest = shortest_distance(structure, &self.neighbours);
        if let Some((i, j, distance)) = shortest.filter(|(_, _, distance)| *distance < MIN_DISTANCE) {
            return Err(FeatureError::Coincident(i, j, distance));
        }
        self.potential.forward(structure, &self.neighbours)?;
        let energy: f64 = self.potential.atomic_energies().iter().sum();
        if !energy.is_finite() {
            return Err(FeatureError::NotFinite(energy));
        }
        Ok(elements)
    }

    /// The derivatives of a function of the last structure's features, from its cotangent, the derivatives with respect to them, [n × D].
    pub fn pull_back(&mut self, cotangent: &[f64], out: &mut PullBack) -> Result<(), PotentialError> {
        self.potential.backward(Some(cotangent), &mut self.of_energy, out)
    }

    /// The derivatives of the last structure's energy and, with a cotangent, those of its features as in [`Self::pull_back`].
    pub fn backward(
        &mut self,
        cotangent: Option<&[f64]>,
        energy: &mut Evaluation,
        out: &mut PullBack,
    ) -> Result<(), PotentialError> {
        self.potential.backward(cotangent, energy, out)
    }

    /// Gradients of combinations of the last structure's features by the coordinates of its atoms, `[weights × 3n]`, 1/Å. Each combination
    /// has a weight for the first features: those of the first atom, then those of the second, and so on.
    pub fn combined_gradients(&mut self, weights: &[Vec<f64>]) -> Result<Vec<f64>, PotentialError> {
        let (mut cotangent, mut pull_back) = (vec![0.0; self.features().len()], PullBack::default());
        let mut rows = Vec::new();
        for weights in weights {
            cotangent[..weights.len()].copy_from_slice(weights);
            self.pull_back(&cotangent, &mut pull_back)?;
            rows.extend_from_slice(pull_back.gradient.as_flattened());
        }
        Ok(rows)
    }

    /// Gradient of the sum of the last structure's features with respect to the coordinates of its atoms, [3n × D], 1/Å. Takes D
    /// reverse sweeps.
    pub fn force_rows(&mut self) -> Result<Vec<f64>, PotentialError> {
        let (dimension, numbers) = (self.dimension(), self.features().len());
        let (mut rows, mut pull_back) = (vec![0.0; 3 * numbers], PullBack::default());
        for feature in 0..dimension {
            let mut cotangent = vec![0.0; numbers];
            cotangent.iter_mut().skip(feature).step_by(dimension).for_each(|c| *c = 1.0);
            self.pull_back(&cotangent, &mut pull_back)?;
            let column = rows.iter_mut().skip(feature).step_by(dimension);
            column.zip(pull_back.gradient.as_flattened()).for_each(|(row, gradient)| *row = *gradient);
        }
        Ok(rows)
    }

    /// Directed bonds of the last structure within the pair cutoffs, to average over neighbourhoods. `elements` are those that
    /// [`Self::compute`] returned.
    pub fn pairs(&self, structure: &Structure, elements: &[usize], weights: NeighbourWeights) -> Vec<Pair> {
        let (model, mut bonds, mut pairs) = (self.potential.model(), Vec::new(), Vec::new());
        for (i, centre) in elements.iter().enumerate() {
            self.neighbours.bonds_within(structure, i, model.cutoff(), &mut bonds);
            pairs.extend(bonds.iter().map(|bond| {
                let j = bond.atom as usize;
                Pair { i, j, weight: weights.weight(bond.r, model.pair_cutoff(*centre, elements[j])) }
            }));
        }
        pairs
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use atoms::{Cell, Species};

    /// Of graded features, which are projected and normalised.
    #[test]
    fn force_rows_are_derivatives_of_sums_of_features() {
        let model = concat!(env!("CARGO_MANIFEST_DIR"), "/configs/data/al_eam_1l/kokkos.npz");
        let mut calculator =
            FeatureCalculator::new(Arc::new(GraceModel::load(std::path::Path::new(model)).unwrap()));
        let structure = Structure {
            species: vec![Species::from_atomic_number(13).unwrap(); 4],
            positions: vec![[0.0, 0.1, 0.0], [0.2, 2.1, 1.9], [2.0, -0.1, 2.2], [2.1, 2.0, 0.1]],
            cell: Cell([[0.0; 3]; 3]),
            periodic: [false; 3],
        };
        calculator.compute(&structure).unwrap();
        let (dimension, rows) = (calculator.dimension(), calculator.force_rows().unwrap());
        assert_eq!(rows.len(), 12 * dimension);
        let mut sums = |shift: f64| {
            let mut moved = structure.clone();
            moved.positions[2][1] += shift;
            calculator.compute(&moved).unwrap();
            let features = calculator.features();
            (0..dimension).map(|k| features.iter().skip(k).step_by(dimension).sum()).collect::<Vec<f64>>()
        };
        let step = 1e-4;
        let (ahead, behind) = (sums(step), sums(-step));
        let row = &rows[7 * dimension..][..dimension];
        let size = row.iter().fold(0.0_f64, |largest, x| largest.max(x.abs()));
        assert!(size > 0.0);
        for (k, found) in row.iter().enumerate() {
            let expected = (ahead[k] - behind[k]) / (2.0 * step);
            assert!((found - expected).abs() < 1e-6 * size, "{k}: {found} {expected}");
        }
    }
}
