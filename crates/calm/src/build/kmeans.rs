//! k-means++ and Lloyd's algorithm with weighted points.

use super::distances::CentroidDistances;
use super::random::Random;

/// Runs of the global k-means from different initial centroids.
const RUNS: usize = 10;

/// Lloyd's algorithm converges in a finite number of iterations; rounding could make it cycle.
const MAX_ITERATIONS: usize = 1000;

/// Weighted points.
#[derive(Debug, Clone, Copy)]
pub(super) struct WeightedPoints<'a> {
    pub dimension: usize,
    /// `[points × D]`, finite.
    pub features: &'a [f64],
    /// `[points]`, finite, not negative.
    pub weights: &'a [f64],
    /// Atoms that each point stands for, `[points]`.
    pub counts: &'a [f64],
}

/// A partition of points.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Clusters {
    /// `[clusters × D]`.
    pub centroids: Vec<f64>,
    /// Atoms of each cluster.
    pub counts: Vec<f64>,
    /// Total weight of each cluster, above zero.
    pub weights: Vec<f64>,
    /// Σ w |**x** − **c**|².
    pub inertia: f64,
}

impl<'a> WeightedPoints<'a> {
    fn row(&self, point: usize) -> &'a [f64] {
        &self.features[point * self.dimension..][..self.dimension]
    }
}

/// Up to `k` initial centroids by greedy k-means++ (Arthur & Vassilvitskii, SODA 2007), `[≤ k × D]`.
///
/// Each centroid is the best of 2 + ⌊ln K⌋ points, drawn with a probability proportional to the weighted squared
/// distance from the centroids before. There are fewer centroids than `k` if there are fewer distinct points.
pub(super) fn initial_centroids(points: &WeightedPoints<'_>, k: usize, random: &mut Random) -> Vec<f64> {
    let trials = 2 + (k as f64).ln() as usize;
    let mut centroids = Vec::new();
    let Some(first) = random.index(&cumulative(points.weights.iter().copied())) else { return centroids };
    centroids.extend_from_slice(points.row(first));
    let mut squared = vec![f64::INFINITY; points.weights.len()];
    lower(points, points.row(first), &mut [&mut squared]);
    while centroids.len() < k * points.dimension {
        let shares = cumulative(squared.iter().zip(points.weights).map(|(d, w)| d * w));
        let drawn: Vec<usize> = (0..trials).map_while(|_| random.index(&shares)).collect();
        let rows: Vec<f64> = drawn.iter().flat_map(|&point| points.row(point)).copied().collect();
        let mut after = vec![squared.clone(); drawn.len()];
        let potentials = lower(points, &rows, &mut after.iter_mut().collect::<Vec<_>>());
        let best = (0..drawn.len()).min_by(|&a, &b| potentials[a].total_cmp(&potentials[b]));
        let Some(best) = best else { return centroids };
        centroids.extend_from_slice(points.row(drawn[best]));
        squared = after.swap_remove(best);
        // The product may leave a rest; then the same point could be drawn again.
        squared[drawn[best]] = 0.0;
    }
    centroids
}

/// Lowers each list of squared distances to those from its centroid. Returns the weighted sum of each list.
fn lower(points: &WeightedPoints<'_>, centroids: &[f64], lists: &mut [&mut Vec<f64>]) -> Vec<f64> {
    let mut sums = vec![0.0; lists.len()];
    let mut distances = CentroidDistances::new(points.dimension, centroids.to_vec());
    distances.for_each_chunk(points.features, |chunk| {
        for atom in 0..chunk.rows().count() {
            let point = chunk.first + atom;
            for (which, squared) in chunk.squared(atom, 0, lists.len()).enumerate() {
                let place = &mut lists[which][point];
                *place = place.min(squared);
                sums[which] += *place * points.weights[point];
            }
        }
    });
    sums
}

/// The sums of the first values, up to each one.
pub(super) fn cumulative(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let sum = |sum: &mut f64, value: f64| {
        *sum += value;
        Some(*sum)
    };
    values.scan(0.0, sum).collect()
}

/// Weighted k-means: the partition of least inertia among ten runs of Lloyd's algorithm, each from initial centroids
/// by k-means++. No cluster is left if no point has a weight.
pub(super) fn weighted_kmeans(points: &WeightedPoints<'_>, k: usize, random: &mut Random) -> Clusters {
    let mut best: Option<Clusters> = None;
    for _ in 0..RUNS {
        let clusters = lloyd(points, initial_centroids(points, k, random), MAX_ITERATIONS);
        if best.as_ref().is_none_or(|best| clusters.inertia < best.inertia) {
            best = Some(clusters);
        }
    }
    best.unwrap_or_default()
}

/// Lloyd's algorithm until no point changes its cluster, for at most `iterations`. Clusters without weight are dropped.
pub(super) fn lloyd(points: &WeightedPoints<'_>, initial: Vec<f64>, iterations: usize) -> Clusters {
    let dimension = points.dimension;
    let mut distances = CentroidDistances::new(dimension, initial);
    let count = distances.count();
    let mut assigned = vec![usize::MAX; points.weights.len()];
    let (mut sums, mut inertia) = (vec![0.0; count * dimension], 0.0);
    let (mut counts, mut weights) = (vec![0.0; count], vec![0.0; count]);
    for _ in 0..iterations {
        for of in [&mut sums, &mut counts, &mut weights] {
            of.fill(0.0);
        }
        inertia = 0.0;
        let mut changed = false;
        distances.for_each_chunk(points.features, |chunk| {
            for (atom, row) in chunk.rows().enumerate() {
                let (slot, squared) = chunk.nearest(atom, 0, count);
                let point = chunk.first + atom;
                let weight = points.weights[point];
                changed |= std::mem::replace(&mut assigned[point], slot) != slot;
                counts[slot] += points.counts[point];
                weights[slot] += weight;
                inertia += weight * squared;
                let sums = &mut sums[slot * dimension..][..dimension];
                sums.iter_mut().zip(row).for_each(|(sum, value)| *sum += weight * value);
            }
        });
        if !changed {
            break;
        }
        distances.change(|centroids| {
            let clusters = centroids.chunks_exact_mut(dimension).zip(sums.chunks_exact(dimension));
            for ((centroid, sums), weight) in clusters.zip(&weights).filter(|(_, weight)| **weight > 0.0) {
                centroid.iter_mut().zip(sums).for_each(|(c, sum)| *c = sum / weight);
            }
        });
    }
    let mut kept = Clusters { inertia, ..Clusters::default() };
    let rows = distances.centroids().chunks_exact(dimension).zip(counts.into_iter().zip(weights));
    for (centroid, (count, weight)) in rows.filter(|(_, (_, weight))| *weight > 0.0) {
        kept.centroids.extend_from_slice(centroid);
        kept.counts.push(count);
        kept.weights.push(weight);
    }
    kept
}
