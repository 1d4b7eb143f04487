//! The frames that the potential was trained on.

use std::panic::resume_unwind;
use std::thread::{self, available_parallelism};

use calm::forgetting::{GradeDistribution, grade_distribution};
use calm::{GradeError, Grades, Mixture};

use super::error::SelectorError;

/// Features of the original training frames. Their γ under the live mixture is monitored: the mixture must not forget
/// what the potential was trained on.
#[derive(Clone, Debug)]
pub struct TrainingFrames {
    /// Element index of each atom.
    pub elements: Vec<usize>,
    /// Features, [atoms × D].
    pub features: Vec<f64>,
    /// Their grades under the original mixture.
    pub original: GradeDistribution,
}

impl TrainingFrames {
    /// Training frames with these features; grades them under the original mixture.
    pub fn new(elements: Vec<usize>, features: Vec<f64>, original: &Mixture) -> Result<Self, GradeError> {
        let original = grade_distribution(original, &elements, &features)?;
        Ok(Self { elements, features, original })
    }

    /// Their grades under another mixture, computed on all cores, since atoms are independent.
    pub(super) fn grades(&self, mixture: &Mixture) -> Result<GradeDistribution, SelectorError> {
        let cores = available_parallelism().map_or(1, |cores| cores.get());
        let atoms = self.elements.len().div_ceil(cores).max(1);
        let parts = self.elements.chunks(atoms).zip(self.features.chunks(atoms * mixture.dimension()));
        let gamma = thread::scope(|scope| {
            let parts: Vec<_> = parts
                .map(|(elements, features)| scope.spawn(move || gamma(mixture, elements, features)))
                .collect();
            let gammas =
                parts.into_iter().map(|part| part.join().unwrap_or_else(|panic| resume_unwind(panic)));
            gammas.collect::<Result<Vec<_>, _>>()
        });
        let gamma = gamma.map_err(|source| SelectorError::Training { source })?;
        Ok(GradeDistribution::from_grades(&gamma.concat()))
    }
}

fn gamma(mixture: &Mixture, elements: &[usize], features: &[f64]) -> Result<Vec<f64>, GradeError> {
    let mut grades = Grades::default();
    grades.evaluate(mixture, elements, features, None)?;
    Ok(grades.gamma)
}
