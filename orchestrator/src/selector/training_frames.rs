//! A sample of the atoms that the potential was trained on.

use std::ops::Range;
use std::panic::resume_unwind;
use std::thread::{self, available_parallelism};

use calm::forgetting::GradeDistribution;
use calm::rules::count_above;
use calm::{GradeError, Grades, Mixture};

use super::error::SelectorError;

/// Features of original training atoms. Their γ under the live mixture is monitored: the mixture must not forget what the
/// potential was trained on.
#[derive(Clone, Debug)]
pub struct TrainingFrames {
    /// The atoms of each element follow one another: element index and place of each, by ascending index.
    elements: Vec<(usize, Range<usize>)>,
    /// Features, [atoms × D].
    features: Vec<f64>,
    /// γ of each atom under the original mixture, and their distribution.
    original: Vec<f64>,
    original_distribution: GradeDistribution,
    /// γ of each atom under the live mixture.
    live: Vec<f64>,
}

impl TrainingFrames {
    /// Takes atoms with these element indices, [n], and features, [n × D], and grades them under the original mixture.
    pub fn new(elements: &[usize], features: &[f64], original: &Mixture) -> Result<Self, GradeError> {
        let dimension = original.dimension();
        let mut order: Vec<usize> = (0..elements.len()).collect();
        order.sort_by_key(|atom| elements[*atom]);
        let sorted: Vec<usize> = order.iter().map(|atom| elements[*atom]).collect();
        let sorted_features: Vec<f64> =
            order.iter().flat_map(|atom| &features[atom * dimension..][..dimension]).copied().collect();
        let mut first = 0;
        let ranges = sorted.chunk_by(|a, b| a == b).map(|atoms| {
            let range = first..first + atoms.len();
            first = range.end;
            (atoms[0], range)
        });
        let gamma = gamma(original, &sorted, &sorted_features)?;
        Ok(Self {
            elements: ranges.collect(),
            features: sorted_features,
            original_distribution: GradeDistribution::from_grades(&gamma),
            live: gamma.clone(),
            original: gamma,
        })
    }

    /// The distribution under the original mixture.
    pub fn original(&self) -> GradeDistribution {
        self.original_distribution
    }

    /// The distribution under the live mixture.
    pub(super) fn live(&self) -> GradeDistribution {
        GradeDistribution::from_grades(&self.live)
    }

    /// Shares of the atoms of one element with γ > 1, under the original and under the live mixture. `None` if there are
    /// fewer than `least`.
    pub(super) fn shares_of(&self, element: usize, least: usize) -> Option<[f64; 2]> {
        let place = self.elements.binary_search_by_key(&element, |(known, _)| *known).ok()?;
        let (_, range) = &self.elements[place];
        let share = |gamma: &[f64]| count_above(gamma, 1.0) as f64 / gamma.len() as f64;
        let shares = || [&self.original, &self.live].map(|gamma| share(&gamma[range.clone()]));
        (range.len() >= least).then(shares)
    }

    /// Grades the atoms again whose element is among `changed`; those of others have the same grades as before. Changes
    /// nothing if an atom cannot be graded.
    pub fn regrade(
        &mut self,
        mixture: &Mixture,
        changed: impl Fn(usize) -> bool,
    ) -> Result<(), SelectorError> {
        let dimension = mixture.dimension();
        let regraded = |(element, range): &(usize, Range<usize>)| {
            let features = &self.features[range.start * dimension..range.end * dimension];
            let graded = gamma(mixture, &vec![*element; range.len()], features);
            graded.map(|graded| (range.clone(), graded))
        };
        let changed = self.elements.iter().filter(|(element, _)| changed(*element));
        let regraded: Result<Vec<_>, GradeError> = changed.map(regraded).collect();
        for (range, graded) in regraded.map_err(|source| SelectorError::Training { source })? {
            self.live[range].copy_from_slice(&graded);
        }
        Ok(())
    }

    /// The original mixture is in force again.
    pub(super) fn restart(&mut self) {
        self.live.clone_from(&self.original);
    }
}

/// Grades on all cores, since atoms are independent.
fn gamma(mixture: &Mixture, elements: &[usize], features: &[f64]) -> Result<Vec<f64>, GradeError> {
    let cores = available_parallelism().map_or(1, |cores| cores.get());
    let atoms = elements.len().div_ceil(cores).max(1);
    let parts = elements.chunks(atoms).zip(features.chunks(atoms * mixture.dimension()));
    let gamma = thread::scope(|scope| {
        let parts: Vec<_> = parts
            .map(|(elements, features)| scope.spawn(move || part_gamma(mixture, elements, features)))
            .collect();
        let gammas = parts.into_iter().map(|part| part.join().unwrap_or_else(|panic| resume_unwind(panic)));
        gammas.collect::<Result<Vec<_>, _>>()
    });
    Ok(gamma?.concat())
}

fn part_gamma(mixture: &Mixture, elements: &[usize], features: &[f64]) -> Result<Vec<f64>, GradeError> {
    let mut grades = Grades::default();
    grades.evaluate(mixture, elements, features, None)?;
    Ok(grades.gamma)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use calm::Component;

    use super::*;

    /// One feature, two elements; γ of an atom is its distance from `centroid`, but for the regularisation.
    fn mixture(centroid: f64) -> Mixture {
        let component = Arc::new(Component::new(vec![centroid], vec![1.0], 1.0, None).unwrap());
        Mixture::new(0, vec![vec![Arc::clone(&component)], vec![component]]).unwrap()
    }

    fn are(found: &[f64], expected: &[f64]) -> bool {
        found.len() == expected.len() && found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-3)
    }

    #[test]
    fn shares_are_those_of_the_atoms_of_an_element() {
        let mut frames = TrainingFrames::new(&[1, 0, 1, 1], &[0.5, 2.0, 3.0, 0.25], &mixture(0.0)).unwrap();
        let third = 1.0 / 3.0;
        assert_eq!([2, 3].map(|least| frames.shares_of(1, least)), [Some([third; 2]); 2]);
        assert_eq!((frames.shares_of(1, 4), frames.shares_of(2, 0)), (None, None));
        assert_eq!(frames.shares_of(0, 1), Some([1.0; 2]));
        assert!(are(&frames.original, &[2.0, 0.5, 3.0, 0.25]));
        let original = GradeDistribution::from_grades(&frames.original);
        assert_eq!((frames.original(), frames.live()), (original, original));
        // Element 0 would have no atom above 1.
        frames.regrade(&mixture(2.5), |element| element == 1).unwrap();
        assert_eq!(frames.shares_of(0, 1), Some([1.0; 2]));
        assert_eq!(frames.shares_of(1, 3), Some([third, 2.0 * third]));
        assert!(are(&frames.live, &[2.0, 2.0, 0.5, 2.25]));
        assert_eq!(frames.live(), GradeDistribution::from_grades(&frames.live));
        assert_eq!(frames.original(), original);
        frames.restart();
        assert_eq!((frames.live(), frames.shares_of(1, 3)), (original, Some([third; 2])));
    }

    #[test]
    fn no_atom_is_left_out_however_many_cores_grade() {
        for atoms in [0, 1, 2, 3, 7, 100] {
            let features: Vec<f64> = (0..atoms).map(|atom| atom as f64).collect();
            let frames = TrainingFrames::new(&vec![0; atoms], &features, &mixture(0.0)).unwrap();
            assert!(are(&frames.live, &features), "{:?}", frames.live);
        }
    }
}
