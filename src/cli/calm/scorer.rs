//! Computes energy, grades and their gradient for one structure after another.

use std::sync::Arc;

use atoms::{Evaluation, NeighbourList, PotentialError, Structure, StructureError, shortest_distance};
use calm::neighbourhood::{Pair, PairError};
use calm::{GradeError, Grades, Mixture, neighbourhood_average};
use potentials::grace::{Grace, GraceModel, PullBack};

/// Shortest accepted distance, Å; the shortest bond, that of H₂, is 0.74 Å. Label programs apply the same limit.
const MIN_DISTANCE: f64 = 0.4;

/// A model, a mixture that grades its features, and work arrays.
pub struct Scorer {
    grace: Grace,
    mixture: Arc<Mixture>,
    neighbours: NeighbourList,
    cotangent: Vec<f64>,
    /// σ, γ and component of the last structure.
    pub grades: Grades,
    /// γ_nbr of the last structure, [n].
    pub gamma_nbr: Vec<f64>,
    /// Energy and forces of the last structure.
    pub evaluation: Evaluation,
    /// ∂Σγ/∂r of the last structure, if requested; otherwise zero.
    pub pull_back: PullBack,
}

/// Why a structure cannot be graded.
#[derive(Debug, thiserror::Error)]
pub enum ScoreError {
    /// An invalid structure.
    #[error(transparent)]
    Structure(#[from] StructureError),
    /// An element that the model does not support.
    #[error(transparent)]
    Potential(#[from] PotentialError),
    /// Features that cannot be graded.
    #[error(transparent)]
    Grade(#[from] GradeError),
    /// Bonds that do not match the grades.
    #[error(transparent)]
    Pair(#[from] PairError),
    /// Overlapping atoms.
    #[error("the energy is {0} eV: do atoms overlap?")]
    NotFinite(f64),
    /// Atoms so close that energy and grades of a model are arbitrary.
    #[error(
        "atoms {0} and {1} are {2:.3} Å apart; expected at least {MIN_DISTANCE} Å: grades are meaningless"
    )]
    Coincident(usize, usize, f64),
}

impl Scorer {
    /// `mixture` must belong to `model`.
    pub fn new(model: Arc<GraceModel>, mixture: Arc<Mixture>) -> Self {
        Self {
            neighbours: NeighbourList::new(model.cutoff(), 0.0),
            grace: Grace::new(model),
            mixture,
            cotangent: Vec::new(),
            grades: Grades::default(),
            gamma_nbr: Vec::new(),
            evaluation: Evaluation::default(),
            pull_back: PullBack::default(),
        }
    }

    /// Features z of the last structure, [n × D].
    pub fn features(&self) -> &[f64] {
        self.grace.features()
    }

    /// Evaluates and grades `structure`; with `gradient`, also computes the gradient of Σγ.
    pub fn score(&mut self, structure: &Structure, gradient: bool) -> Result<(), ScoreError> {
        let elements = self.grace.model().element_indices(&structure.species)?;
        self.neighbours.update(structure)?;
        let shortest = shortest_distance(structure, &self.neighbours);
        if let Some((i, j, distance)) = shortest.filter(|(_, _, distance)| *distance < MIN_DISTANCE) {
            return Err(ScoreError::Coincident(i, j, distance));
        }
        self.grace.forward(structure, &self.neighbours)?;
        let energy: f64 = self.grace.atomic_energies().iter().sum();
        if !energy.is_finite() {
            return Err(ScoreError::NotFinite(energy));
        }
        let features = self.grace.features();
        self.cotangent.resize(features.len(), 0.0);
        let cotangent = gradient.then_some(self.cotangent.as_mut_slice());
        self.grades.evaluate(&self.mixture, &elements, features, cotangent)?;
        let pairs = self.pairs(structure, &elements);
        self.gamma_nbr = neighbourhood_average(&self.grades.gamma, pairs)?;
        let cotangent = gradient.then_some(self.cotangent.as_slice());
        self.grace.backward(cotangent, &mut self.evaluation, &mut self.pull_back);
        Ok(())
    }

    /// Directed bonds within the pair cutoffs.
    fn pairs(&self, structure: &Structure, elements: &[usize]) -> Vec<Pair> {
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
