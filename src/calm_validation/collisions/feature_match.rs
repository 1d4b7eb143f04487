//! How far the features of an atom are from given ones, with the gradient by the positions of its neighbours.

use atoms::cell::{norm, sub};
use atoms::{Cell, Species, Structure, Vec3};
use potentials::grace::PullBack;

use crate::features::FeatureCalculator;

/// Distances that neighbours keep, Å.
#[derive(Clone, Copy, Debug)]
pub struct AllowedDistances {
    /// From each other and from the atom in the middle.
    pub closest: f64,
    /// From the atom in the middle.
    pub farthest: f64,
}

/// The function that is minimised: |z − z_A|² / |z_A|² of the atom in the middle, and a penalty on distances that are not allowed.
pub struct FeatureMatch<'a> {
    calculator: &'a mut FeatureCalculator,
    species: Species,
    allowed: AllowedDistances,
    /// z_A
    target: Vec<f64>,
    pull_back: PullBack,
}

impl<'a> FeatureMatch<'a> {
    /// To the features of an atom with these neighbours. `None` if it has none, or if all are zero.
    pub fn new(
        calculator: &'a mut FeatureCalculator,
        species: Species,
        allowed: AllowedDistances,
        neighbours: &[Vec3],
    ) -> Option<Self> {
        calculator.compute(&cluster(species, neighbours)).ok()?;
        let target = calculator.features()[..calculator.dimension()].to_vec();
        let is_valid = square(&target) > 0.0 && target.iter().all(|z| z.is_finite());
        is_valid.then(|| Self { calculator, species, allowed, target, pull_back: PullBack::default() })
    }

    /// |z − z_A| / |z_A| of an atom with these neighbours. `None` if it has no features.
    pub fn distance(&mut self, neighbours: &[Vec3]) -> Option<f64> {
        self.deviations(neighbours).map(|deviations| self.relative(&deviations))
    }

    /// |z − z_A| / |z_A|
    pub fn relative(&self, deviations: &[f64]) -> f64 {
        (square(deviations) / square(&self.target)).sqrt()
    }

    /// D
    pub fn dimension(&self) -> usize {
        self.target.len()
    }

    /// Gradients of combinations of the features of the last environment by the coordinates of its m neighbours, `[weights × 3m]`, 1/Å.
    /// `None` if the model does not answer.
    pub fn combined_gradients(&mut self, weights: &[Vec<f64>]) -> Option<Vec<f64>> {
        let columns = 3 * self.calculator.features().len() / self.target.len();
        let rows = self.calculator.combined_gradients(weights).ok()?;
        Some(rows.chunks_exact(columns).flat_map(|row| &row[3..]).copied().collect())
    }

    /// The function for the coordinates of the neighbours, `[3m]`, Å; writes its gradient, 1/Å. `None` without features.
    pub fn evaluate(&mut self, coordinates: &[f64], gradient: &mut [f64]) -> Option<f64> {
        let (neighbours, _) = coordinates.as_chunks::<3>();
        let deviations = self.deviations(neighbours)?;
        let size = square(&self.target);
        let mut cotangent = vec![0.0; self.calculator.features().len()];
        cotangent.iter_mut().zip(&deviations).for_each(|(c, deviation)| *c = 2.0 * deviation / size);
        self.calculator.pull_back(&cotangent, &mut self.pull_back).ok()?;
        gradient.copy_from_slice(self.pull_back.gradient[1..].as_flattened());
        let (of_neighbours, _) = gradient.as_chunks_mut::<3>();
        Some(square(&deviations) / size + self.allowed.penalty(neighbours, of_neighbours))
    }

    /// z − z_A of an atom with these neighbours. `None` if it has no features.
    pub fn deviations(&mut self, neighbours: &[Vec3]) -> Option<Vec<f64>> {
        self.calculator.compute(&cluster(self.species, neighbours)).ok()?;
        let found = self.calculator.features().iter();
        Some(self.target.iter().zip(found).map(|(target, found)| found - target).collect())
    }
}

impl AllowedDistances {
    /// Σ (1 − r / closest)² over distances that are too short and Σ (r / farthest − 1)² over those that are too long; adds the gradient.
    pub fn penalty(self, neighbours: &[Vec3], gradient: &mut [Vec3]) -> f64 {
        let mut sum = 0.0;
        for (i, a) in neighbours.iter().enumerate() {
            let r = norm(*a);
            for (value, slope) in [self.too_short(r), self.too_long(r)].into_iter().flatten() {
                sum += value;
                add_along(&mut gradient[i], *a, slope / r);
            }
            for (j, b) in neighbours[..i].iter().enumerate() {
                let apart = sub(*a, *b);
                let r = norm(apart);
                if let Some((value, slope)) = self.too_short(r) {
                    sum += value;
                    add_along(&mut gradient[i], apart, slope / r);
                    add_along(&mut gradient[j], apart, -slope / r);
                }
            }
        }
        sum
    }

    /// The penalty of a distance and its derivative, 1/Å.
    fn too_short(self, r: f64) -> Option<(f64, f64)> {
        let lack = 1.0 - r / self.closest;
        (lack > 0.0).then_some((lack * lack, -2.0 * lack / self.closest))
    }

    /// The same for a distance from the middle.
    fn too_long(self, r: f64) -> Option<(f64, f64)> {
        let excess = r / self.farthest - 1.0;
        (excess > 0.0).then_some((excess * excess, 2.0 * excess / self.farthest))
    }
}

/// Adds `factor` · `direction`.
fn add_along(sum: &mut Vec3, direction: Vec3, factor: f64) {
    sum.iter_mut().zip(direction).for_each(|(sum, x)| *sum += factor * x);
}

/// An atom at the origin with these neighbours, all of one element.
pub fn cluster(species: Species, neighbours: &[Vec3]) -> Structure {
    Structure {
        species: vec![species; 1 + neighbours.len()],
        positions: [&[[0.0; 3]][..], neighbours].concat(),
        cell: Cell([[0.0; 3]; 3]),
        periodic: [false; 3],
    }
}

fn square(numbers: &[f64]) -> f64 {
    numbers.iter().map(|x| x * x).sum()
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::sync::Arc;

    use potentials::grace::GraceModel;

    use super::super::environments::random_neighbours;
    use super::*;
    use crate::calm_validation::random::RandomSequence;

    const M: usize = 7;

    fn neighbours(sequence: u64) -> Vec<Vec3> {
        random_neighbours(M, 4.5, 2.0, &mut RandomSequence::new(5, sequence)).unwrap()
    }

    /// Checks a gradient against differences of the function at all coordinates.
    fn check(start: &[f64], mut f: impl FnMut(&[f64], &mut [f64]) -> Option<f64>) {
        let (mut gradient, mut unused) = (vec![0.0; start.len()], vec![0.0; start.len()]);
        f(start, &mut gradient).unwrap();
        let largest = gradient.iter().fold(0.0, |largest: f64, x| largest.max(x.abs()));
        assert!(largest > 1e-3, "{gradient:?}");
        let step = 1e-4;
        for k in 0..start.len() {
            let mut at = |shift: f64| {
                let mut moved = start.to_vec();
                moved[k] += shift;
                f(&moved, &mut unused).unwrap()
            };
            let difference = (at(step) - at(-step)) / (2.0 * step);
            assert!((difference - gradient[k]).abs() < 1e-4 * largest, "{k}: {difference} {gradient:?}");
        }
    }

    #[test]
    fn the_gradient_is_that_of_the_function() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/data/al_eam_1l/kokkos.npz");
        let model = Arc::new(GraceModel::load(&path).unwrap());
        let species = model.elements()[0];
        // Some distances are too short and some too long.
        let allowed = AllowedDistances { closest: 2.6, farthest: 4.0 };
        let (first, second) = (neighbours(1), neighbours(2));
        for mut calculator in
            [FeatureCalculator::new(model.clone()), FeatureCalculator::of_hidden_layer(model.clone())]
        {
            let mut matched = FeatureMatch::new(&mut calculator, species, allowed, &first).unwrap();
            assert_eq!(matched.distance(&first), Some(0.0));
            assert!(matched.distance(&second).unwrap() > 1e-3);
            check(second.as_flattened(), |x, gradient| matched.evaluate(x, gradient));
        }
    }

    #[test]
    fn distances_that_are_not_allowed_cost_something() {
        let (wide, second) = (AllowedDistances { closest: 1.9, farthest: 4.6 }, neighbours(2));
        assert_eq!(wide.penalty(&second, &mut [[0.0; 3]; M]), 0.0);
        let narrow = AllowedDistances { closest: 3.0, farthest: 3.5 };
        check(second.as_flattened(), |x, gradient| {
            gradient.fill(0.0);
            Some(narrow.penalty(x.as_chunks().0, gradient.as_chunks_mut().0))
        });
        // A pair and the middle, with neighbours at 2 Å on both sides: 1/3 too short, the pair itself 4 Å apart.
        let line = [[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]];
        let mut gradient = [[0.0; 3]; 2];
        assert!((narrow.penalty(&line, &mut gradient) - 2.0 / 9.0).abs() < 1e-12);
        assert!((gradient[0][0] + 2.0 / 9.0).abs() < 1e-12 && gradient[1][0] == -gradient[0][0]);
    }
}
