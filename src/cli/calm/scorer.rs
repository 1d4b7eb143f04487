//! Computes energy, grades and their gradient for one structure after another.

use std::sync::Arc;

use atoms::{Evaluation, NeighbourList, Structure};
use calm::neighbourhood::{Pair, PairError};
use calm::{GradeError, Grades, Mixture, NeighbourWeights, neighbourhood_average};
use potentials::grace::PullBack;

use crate::feature_variant::FeatureModel;
use crate::features::{FeatureCalculator, FeatureError};

/// A model, a mixture that grades its features, and work arrays.
pub struct Scorer {
    features: FeatureCalculator,
    mixture: Arc<Mixture>,
    cotangent: Vec<f64>,
    /// σ, γ and component of the last structure.
    pub grades: Grades,
    /// γ_nbr of the last structure, [n].
    pub gamma_nbr: Vec<f64>,
    /// The bonds over which γ_nbr averages.
    pub pairs: Vec<Pair>,
    /// Element indices of the last structure, [n].
    pub elements: Vec<usize>,
    /// Energy and forces of the last structure.
    pub evaluation: Evaluation,
    /// ∂Σγ/∂r of the last structure, if requested; otherwise zero.
    pub pull_back: PullBack,
}

/// Why a structure cannot be graded.
#[derive(Debug, thiserror::Error)]
pub enum ScoreError {
    /// A structure without meaningful features.
    #[error(transparent)]
    Features(#[from] FeatureError),
    /// Features that cannot be graded.
    #[error(transparent)]
    Grade(#[from] GradeError),
    /// Bonds that do not match the grades.
    #[error(transparent)]
    Pair(#[from] PairError),
}

impl ScoreError {
    /// Whether other structures may be graded.
    pub fn is_of_structure(&self) -> bool {
        match self {
            Self::Features(error) => error.is_of_structure(),
            Self::Grade(_) => true,
            Self::Pair(_) => false,
        }
    }
}

impl Scorer {
    /// `mixture` must be one of these features.
    pub fn new(features: &FeatureModel, mixture: Arc<Mixture>) -> Self {
        Self {
            features: features.calculator(),
            mixture,
            cotangent: Vec::new(),
            grades: Grades::default(),
            gamma_nbr: Vec::new(),
            pairs: Vec::new(),
            elements: Vec::new(),
            evaluation: Evaluation::default(),
            pull_back: PullBack::default(),
        }
    }

    /// Neighbours in the last structure within the cutoff of the model.
    pub fn neighbours(&self) -> &NeighbourList {
        &self.features.neighbours
    }

    /// Features z of the last structure, [n × D].
    pub fn features(&self) -> &[f64] {
        self.features.features()
    }

    /// The average of γ over the neighbours of the last structure with other weights than γ_nbr has, [n].
    pub fn gamma_average(
        &self,
        structure: &Structure,
        weights: NeighbourWeights,
    ) -> Result<Vec<f64>, PairError> {
        neighbourhood_average(&self.grades.gamma, self.features.pairs(structure, &self.elements, weights))
    }

    /// Evaluates and grades `structure`; with `gradient`, also computes the gradient of Σγ.
    pub fn score(&mut self, structure: &Structure, gradient: bool) -> Result<(), ScoreError> {
        let elements = self.features.compute(structure)?;
        let features = self.features.features();
        self.cotangent.resize(features.len(), 0.0);
        let cotangent = gradient.then_some(self.cotangent.as_mut_slice());
        self.grades.evaluate(&self.mixture, &elements, features, cotangent)?;
        self.pairs = self.features.pairs(structure, &elements, NeighbourWeights::default());
        self.elements = elements;
        self.gamma_nbr = neighbourhood_average(&self.grades.gamma, self.pairs.iter().copied())?;
        let cotangent = gradient.then_some(self.cotangent.as_slice());
        Ok(self
            .features
            .backward(cotangent, &mut self.evaluation, &mut self.pull_back)
            .map_err(FeatureError::from)?)
    }
}
