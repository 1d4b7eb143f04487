//! Squared distances of many atoms to many centroids by one matrix product, |**x** − **c**|² = |**x**|² − 2 **x**·**c** + |**c**|².

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, Par};

use super::error::{BuildError, expect_length};
use crate::grade::nearest;
use crate::linear::{dot, row_dots, view};

/// Atoms of one product: their products with a few dozen centroids fit the second-level cache beside their features.
const ATOMS_PER_PRODUCT: usize = 128;

/// Centroids with buffers for distances to them.
#[derive(Debug, Clone)]
pub(super) struct CentroidDistances {
    dimension: usize,
    centroids: Vec<f64>,
    /// |**c**|² of each centroid.
    squares: Vec<f64>,
    /// **x**·**c**, `[atoms × centroids]`.
    products: Vec<f64>,
    /// |**x**|² of each atom of the batch.
    lengths: Vec<f64>,
}

/// A chunk of a batch with its products.
pub(super) struct DistanceChunk<'a> {
    /// Index of its first atom in the batch.
    pub first: usize,
    features: &'a [f64],
    of: &'a CentroidDistances,
}

impl CentroidDistances {
    /// Centroids, `[K × D]`.
    pub fn new(dimension: usize, centroids: Vec<f64>) -> Self {
        let mut distances = Self { dimension, centroids, squares: vec![], products: vec![], lengths: vec![] };
        distances.measure_centroids();
        distances
    }

    /// Number of centroids.
    pub fn count(&self) -> usize {
        self.squares.len()
    }

    /// The centroids, `[K × D]`.
    pub fn centroids(&self) -> &[f64] {
        &self.centroids
    }

    /// Changes the centroids.
    pub fn change(&mut self, change: impl FnOnce(&mut [f64])) {
        change(&mut self.centroids);
        self.measure_centroids();
    }

    fn measure_centroids(&mut self) {
        self.squares.clear();
        self.squares.extend(self.centroids.chunks_exact(self.dimension).map(|c| dot(c, c)));
    }

    /// As [`check`].
    pub fn check(&mut self, features: &[f64]) -> Result<usize, BuildError> {
        check(features, self.dimension, &mut self.lengths)
    }

    /// Calls `visit` with each chunk of a batch of finite features, `[atoms × D]`, in order.
    pub fn for_each_chunk(&mut self, features: &[f64], visit: impl FnMut(&DistanceChunk<'_>)) {
        row_dots(features, features, self.dimension, &mut self.lengths);
        self.for_each_checked_chunk(features, visit);
    }

    /// Calls `visit` with each chunk of the batch that [`Self::check`] accepted last, in order.
    pub fn for_each_checked_chunk(&mut self, features: &[f64], mut visit: impl FnMut(&DistanceChunk<'_>)) {
        for (index, chunk) in features.chunks(ATOMS_PER_PRODUCT * self.dimension).enumerate() {
            self.multiply(chunk);
            visit(&DistanceChunk { first: index * ATOMS_PER_PRODUCT, features: chunk, of: self });
        }
    }

    fn multiply(&mut self, features: &[f64]) {
        let (dimension, count) = (self.dimension, self.squares.len());
        let atoms = features.len() / dimension;
        self.products.resize(atoms * count, 0.0);
        if count > 1 {
            let products = MatMut::from_row_major_slice_mut(&mut self.products, atoms, count);
            let centroids = view(&self.centroids, count, dimension).transpose();
            matmul(products, Accum::Replace, view(features, atoms, dimension), centroids, 1.0, Par::Seq);
        } else if let Some(centroid) = self.centroids.get(..dimension) {
            let products = self.products.iter_mut().zip(features.chunks_exact(dimension));
            products.for_each(|(product, x)| *product = dot(x, centroid));
        }
    }
}

/// Checks a batch of features, `[atoms × D]`, and returns the number of its atoms. Fills `lengths` with |**x**|².
///
/// # Errors
/// A length that is no multiple of D, features that are not finite or too large to be squared.
pub(super) fn check(features: &[f64], dimension: usize, lengths: &mut Vec<f64>) -> Result<usize, BuildError> {
    let atoms = features.len() / dimension;
    expect_length("features", features.len(), atoms * dimension)?;
    row_dots(features, features, dimension, lengths);
    match lengths.iter().position(|length| !length.is_finite()) {
        Some(atom) => Err(BuildError::Features { atom, found: lengths[atom] }),
        None => Ok(atoms),
    }
}

impl DistanceChunk<'_> {
    /// Features of its atoms, one after the other.
    pub fn rows(&self) -> impl Iterator<Item = &[f64]> {
        self.features.chunks_exact(self.of.dimension)
    }

    /// One of the centroids.
    pub fn centroid(&self, slot: usize) -> &[f64] {
        &self.of.centroids[slot * self.of.dimension..][..self.of.dimension]
    }

    /// |**x** − **c**|² of an atom of the chunk to the centroids `first..first + count`, not below zero.
    pub fn squared(&self, atom: usize, first: usize, count: usize) -> impl Iterator<Item = f64> {
        let products = &self.of.products[atom * self.of.count() + first..][..count];
        let length = self.of.lengths[self.first + atom];
        products.iter().zip(&self.of.squares[first..]).map(move |(p, c)| (length - 2.0 * p + c).max(0.0))
    }

    /// Index and squared distance of the nearest of the centroids `first..first + count`, the first if several are
    /// equally near.
    pub fn nearest(&self, atom: usize, first: usize, count: usize) -> (usize, f64) {
        let mut best = (0, f64::INFINITY);
        for (slot, squared) in self.squared(atom, first, count).enumerate() {
            if squared < best.1 {
                best = (slot, squared);
            }
        }
        best
    }

    /// Index of the nearest of all centroids, the same as that of [`nearest`]: where rounding could decide, this
    /// compares the distances of that function.
    pub fn assigned(&self, atom: usize) -> usize {
        let (mut best, mut least, mut second) = (0, f64::INFINITY, f64::INFINITY);
        let (dimension, count) = (self.of.dimension, self.of.count());
        let products = &self.of.products[atom * count..][..count];
        let mut largest = self.of.lengths[self.first + atom];
        for (slot, (product, square)) in products.iter().zip(&self.of.squares).enumerate() {
            let relative = square - 2.0 * product;
            largest = largest.max(*square);
            if relative < least {
                (best, least, second) = (slot, relative, least);
            } else if relative < second {
                second = relative;
            }
        }
        // More than the rounding of both differences of sums over D features.
        let uncertain = 8.0 * (dimension + 4) as f64 * f64::EPSILON * largest;
        if second - least > uncertain {
            return best;
        }
        let row = &self.features[atom * dimension..][..dimension];
        nearest(self.of.centroids.chunks_exact(dimension), row)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::build::random::Random;
    use crate::linear::squared_distance;

    fn numbers(seed: u64, count: usize) -> Vec<f64> {
        let mut random = Random::new(&[seed]);
        (0..count).map(|_| 4.0 * random.uniform() - 2.0).collect()
    }

    #[test]
    fn products_give_the_distances() {
        for (dimension, count, atoms) in [(1, 1, 3), (3, 2, 1), (5, 31, 700), (130, 8, 300)] {
            let (centroids, features) = (numbers(1, dimension * count), numbers(2, dimension * atoms));
            let mut distances = CentroidDistances::new(dimension, centroids.clone());
            let mut seen = 0;
            let visit = |chunk: &DistanceChunk<'_>| {
                assert_eq!(chunk.first, seen);
                for (atom, row) in chunk.rows().enumerate() {
                    let direct: Vec<f64> =
                        centroids.chunks_exact(dimension).map(|c| squared_distance(row, c)).collect();
                    for (found, expected) in chunk.squared(atom, 0, count).zip(&direct) {
                        assert!((found - expected).abs() < 1e-12 * (1.0 + expected), "{found} {expected}");
                    }
                    let (slot, squared) = chunk.nearest(atom, count / 2, count - count / 2);
                    assert!((squared - direct[count / 2 + slot]).abs() < 1e-11);
                    seen += 1;
                }
            };
            distances.for_each_chunk(&features, visit);
            assert_eq!(seen, atoms);
        }
    }

    #[test]
    fn an_atom_is_assigned_as_it_is_graded() {
        let dimension = 40;
        // Pairs of equal centroids, and pairs that differ by rounding; atoms half-way between others.
        let mut centroids = numbers(3, 6 * dimension);
        let copy = centroids.clone();
        centroids
            .extend(copy.iter().enumerate().map(|(k, c)| if k % 2 == 0 { *c } else { c * (1.0 + 3e-16) }));
        let mut features = numbers(4, 50 * dimension);
        for a in 0..6 {
            for b in 0..6 {
                let (a, b) = (&copy[a * dimension..][..dimension], &copy[b * dimension..][..dimension]);
                features.extend(a.iter().zip(b).map(|(a, b)| 0.5 * (a + b)));
            }
        }
        // Far from the origin, products lose digits.
        features.iter_mut().chain(&mut centroids).for_each(|value| *value += 1e4);
        let mut distances = CentroidDistances::new(dimension, centroids.clone());
        let visit = |chunk: &DistanceChunk<'_>| {
            for (atom, row) in chunk.rows().enumerate() {
                assert_eq!(chunk.assigned(atom), nearest(centroids.chunks_exact(dimension), row));
            }
        };
        distances.for_each_chunk(&features, visit);
    }

    #[test]
    fn wrong_features_are_errors() {
        let mut lengths = Vec::new();
        assert_eq!(check(&[0.0, 1.0, 2.0, 3.0], 2, &mut lengths), Ok(2));
        let found = check(&[0.0, 1.0, 2.0], 2, &mut lengths).unwrap_err();
        assert_eq!(found.to_string(), "features: found 3 numbers, expected 2");
        for wrong in [f64::NAN, f64::INFINITY, 1e200] {
            let found = check(&[0.0, 1.0, 2.0, wrong], 2, &mut lengths).unwrap_err();
            assert!(found.to_string().starts_with("features of atom 1 of the batch"), "{found}");
        }
    }
}
