//! Computes energy and all scores of one structure after another.

use std::sync::Arc;

use atoms::Structure;
use calm::{Grades, Mixture, NeighbourWeights, neighbourhood_average};

use super::{DetectionRule, Subject};
use crate::features::FeatureCalculator;

/// A score of atoms to compare γ with.
pub trait AtomScore: Send + Sync {
    /// Its name.
    fn name(&self) -> &str;

    /// When it detects a regime of a bond scan; `None` for a score without zero.
    fn rule(&self) -> Option<DetectionRule>;

    /// The same score for another thread, with work arrays of its own.
    fn for_thread(&self) -> Box<dyn AtomScore>;

    /// One number for each atom, larger further outside. `elements` has the element index of each atom, `features` those that γ
    /// grades, `[atoms × D]`.
    ///
    /// # Errors
    /// Why the structure cannot be scored.
    fn score(
        &mut self,
        structure: &Structure,
        elements: &[usize],
        features: &[f64],
    ) -> Result<Vec<f64>, String>;
}

/// The model with all scores, and work arrays.
pub struct ValidationGrader {
    pub features: FeatureCalculator,
    mixture: Arc<Mixture>,
    others: Vec<Box<dyn AtomScore>>,
    grades: Grades,
}

/// Energy and scores of a structure.
pub struct Graded {
    /// eV.
    pub energy: f64,
    /// Scores of the atoms, γ first, `[scores][atoms]`.
    pub scores: Vec<Vec<f64>>,
    /// Their neighbourhood averages.
    pub averages: Vec<Vec<f64>>,
}

impl ValidationGrader {
    pub fn new(subject: &Subject) -> Self {
        Self {
            features: FeatureCalculator::new(subject.model.shared()),
            mixture: subject.mixture.clone(),
            others: subject.others.iter().map(|score| score.for_thread()).collect(),
            grades: Grades::default(),
        }
    }

    /// The energy of `structure`, eV. `None` if it cannot be computed.
    pub fn energy(&mut self, structure: &Structure) -> Option<f64> {
        self.features.compute(structure).ok()?;
        Some(self.features.potential.atomic_energies().iter().sum())
    }

    /// Energy and scores of `structure`.
    ///
    /// # Errors
    /// Why it cannot be graded: atoms so close that energy or features are not finite.
    pub fn grade(&mut self, structure: &Structure) -> Result<Graded, String> {
        let elements = self.features.compute(structure).map_err(|error| error.to_string())?;
        let features = self.features.potential.features();
        self.grades.evaluate(&self.mixture, &elements, features, None).map_err(|error| error.to_string())?;
        let mut scores = vec![self.grades.gamma.clone()];
        for other in &mut self.others {
            scores.push(other.score(structure, &elements, features)?);
        }
        let pairs = self.features.pairs(structure, &elements, NeighbourWeights::default());
        let average = |score: &Vec<f64>| neighbourhood_average(score, pairs.iter().copied());
        let averages = scores.iter().map(average).collect::<Result<_, _>>();
        let energy = self.features.potential.atomic_energies().iter().sum();
        Ok(Graded { energy, averages: averages.map_err(|error| error.to_string())?, scores })
    }
}
