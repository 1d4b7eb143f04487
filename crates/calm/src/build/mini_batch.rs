//! Pass 1: mini-batch k-means of the atoms of one element and shard, for all candidates K from one stream.

use serde::{Deserialize, Serialize};

use super::distances::CentroidDistances;
use super::error::{BuildError, expect_weights};
use super::kmeans::{WeightedPoints, cumulative, initial_centroids, lloyd};
use super::random::Random;
use super::settings::BuildSettings;
use crate::linear::squared_distance;

/// Fewest atoms of a mini-batch.
const MIN_BATCH: usize = 1024;

/// Iterations of Lloyd's algorithm that improve the initial centroids.
const REFINEMENTS: usize = 3;

/// Least share of the largest cluster's weight that lets a cluster keep its centroid.
const MIN_SHARE: f64 = 0.01;

/// Mini-batch k-means (Sculley, WWW 2010) of the atoms of one element and shard.
///
/// The stream is cut into mini-batches of max(10 K_max, 1024) atoms wherever the caller's batches end, so the result
/// depends only on the order of the atoms. Centroids follow the data seen first: shuffle the structures.
/// The first mini-batch gives the initial centroids by k-means++ and three iterations of Lloyd's algorithm; if it has
/// fewer distinct atoms than K, there are as many centroids. Each mini-batch then moves the centroids:
///
/// **c** ← **c** + (Σ w **x** − m **c**) / (n + m),  n ← n + m,
///
/// where the sum is over its atoms nearest to **c**, m is their weight, and n the weight of all atoms before them.
///
/// **Reassignment.** After each mini-batch, a centroid moves if its cluster has less than 1 % of the weight of the largest
/// cluster, both of the mini-batch and of all mini-batches. It moves to an atom of the mini-batch, drawn as by k-means++
/// with a probability proportional to its weight times its squared distance from the nearest centroid. The nearest other
/// cluster gets its atoms and weight.
///
/// Atoms without weight are left out.
#[derive(Debug, Clone)]
pub struct ShardClustering {
    settings: BuildSettings,
    shard: u64,
    element: usize,
    /// Atoms of the next mini-batch, `[atoms × D]`, and their weights.
    pending: Vec<f64>,
    weights: Vec<f64>,
    /// Of all mini-batches.
    atoms: u64,
    weight: f64,
    /// One for each candidate once the first mini-batch has been seen.
    candidates: Vec<CandidateState>,
    /// The centroids of all candidates.
    distances: CentroidDistances,
}

/// The clusters that a shard found for an element. Serialisable, so that a build continues after its last finished
/// shard.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ShardClusters {
    /// Index of the shard.
    pub shard: u64,
    /// Element index.
    pub element: usize,
    /// Atoms of the element in the shard that have a weight.
    pub atoms: u64,
    /// Sum of their weights.
    pub weight: f64,
    /// The clusters for each candidate K; empty without atoms.
    pub candidates: Vec<CandidateClusters>,
}

/// The clusters for one candidate K.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CandidateClusters {
    /// Centroids, `[clusters × D]`: K, or as many as there are distinct atoms.
    pub centroids: Vec<f64>,
    /// Atoms of each cluster, `[clusters]`.
    pub counts: Vec<f64>,
    /// Sum of their weights, `[clusters]`.
    pub weights: Vec<f64>,
    /// Σ w |**x** − **c**|² over the atoms, each to the nearest centroid when its mini-batch was assigned.
    pub inertia: f64,
}

#[derive(Debug, Clone)]
struct CandidateState {
    random: Random,
    /// Index of its first centroid among those of all candidates.
    first: usize,
    counts: Vec<f64>,
    weights: Vec<f64>,
    inertia: f64,
    /// Of the current mini-batch: weighted sums of features, `[clusters × D]`, and weight of each cluster.
    sums: Vec<f64>,
    added: Vec<f64>,
    /// Weighted squared distance of each of its atoms to the nearest centroid.
    squared: Vec<f64>,
}

impl ShardClustering {
    /// Begins a shard.
    ///
    /// # Errors
    /// Invalid settings.
    pub fn new(settings: &BuildSettings, shard: u64, element: usize) -> Result<Self, BuildError> {
        settings.check()?;
        Ok(Self {
            shard,
            element,
            pending: Vec::new(),
            weights: Vec::new(),
            atoms: 0,
            weight: 0.0,
            candidates: Vec::new(),
            distances: CentroidDistances::new(settings.dimension, Vec::new()),
            settings: settings.clone(),
        })
    }

    /// Adds atoms of the element: `features` is `[atoms × D]`, `weights` has one number for each atom.
    ///
    /// # Errors
    /// Wrong lengths, features that are not finite, weights that are negative or not finite. Nothing is added then.
    pub fn add(&mut self, features: &[f64], weights: &[f64]) -> Result<(), BuildError> {
        let atoms = self.distances.check(features)?;
        expect_weights(weights, atoms)?;
        let rows = features.chunks_exact(self.settings.dimension).zip(weights);
        for (row, &weight) in rows.filter(|(_, weight)| **weight > 0.0) {
            self.pending.extend_from_slice(row);
            self.weights.push(weight);
            if self.weights.len() == self.batch_atoms() {
                self.step();
            }
        }
        Ok(())
    }

    /// Ends the shard.
    pub fn finish(mut self) -> ShardClusters {
        if !self.pending.is_empty() {
            self.step();
        }
        let Self { shard, element, atoms, weight, candidates, distances, settings, .. } = self;
        let centroids = distances.centroids().chunks_exact(settings.dimension);
        let clusters = candidates.into_iter().map(|candidate| CandidateClusters {
            centroids: centroids
                .clone()
                .skip(candidate.first)
                .take(candidate.counts.len())
                .flatten()
                .copied()
                .collect(),
            counts: candidate.counts,
            weights: candidate.weights,
            inertia: candidate.inertia,
        });
        ShardClusters { shard, element, atoms, weight, candidates: clusters.collect() }
    }

    fn batch_atoms(&self) -> usize {
        self.settings.candidates.last().map_or(MIN_BATCH, |most| MIN_BATCH.max(10 * most))
    }

    /// Moves the centroids by the pending mini-batch.
    fn step(&mut self) {
        let (batch, weights) = (std::mem::take(&mut self.pending), std::mem::take(&mut self.weights));
        self.atoms += weights.len() as u64;
        weights.iter().for_each(|weight| self.weight += weight);
        if self.candidates.is_empty() {
            self.initialise(&batch, &weights);
        }
        let Self { candidates, distances, .. } = self;
        candidates.iter_mut().for_each(CandidateState::begin_batch);
        let mut weighted = vec![0.0; self.settings.dimension];
        distances.for_each_chunk(&batch, |chunk| {
            for (atom, row) in chunk.rows().enumerate() {
                let weight = weights[chunk.first + atom];
                weighted.iter_mut().zip(row).for_each(|(out, value)| *out = weight * value);
                for candidate in &mut *candidates {
                    let (slot, squared) = chunk.nearest(atom, candidate.first, candidate.counts.len());
                    candidate.assign(&weighted, weight, slot, squared);
                }
            }
        });
        let dimension = self.settings.dimension;
        distances.change(|centroids| {
            for candidate in candidates {
                let own = &mut centroids[candidate.first * dimension..][..candidate.sums.len()];
                candidate.advance(own, dimension);
                candidate.reassign(own, (&batch, &weights), dimension);
            }
        });
        (self.pending, self.weights) = (batch, weights);
        self.pending.clear();
        self.weights.clear();
    }

    fn initialise(&mut self, batch: &[f64], weights: &[f64]) {
        let dimension = self.settings.dimension;
        let points =
            WeightedPoints { dimension, features: batch, weights, counts: &vec![1.0; weights.len()] };
        let mut all = Vec::new();
        for &k in &self.settings.candidates {
            let words = [self.settings.seed, self.shard, self.element as u64, k as u64];
            let mut random = Random::new(&words);
            let initial = initial_centroids(&points, k, &mut random);
            let centroids = lloyd(&points, initial, REFINEMENTS).centroids;
            self.candidates.push(CandidateState {
                random,
                first: all.len() / dimension,
                counts: vec![0.0; centroids.len() / dimension],
                weights: vec![0.0; centroids.len() / dimension],
                inertia: 0.0,
                sums: vec![0.0; centroids.len()],
                added: vec![0.0; centroids.len() / dimension],
                squared: Vec::new(),
            });
            all.extend(centroids);
        }
        self.distances = CentroidDistances::new(dimension, all);
    }
}

impl CandidateState {
    fn begin_batch(&mut self) {
        self.sums.fill(0.0);
        self.added.fill(0.0);
        self.squared.clear();
    }

    /// `weighted` is the weight times the features of an atom.
    fn assign(&mut self, weighted: &[f64], weight: f64, slot: usize, squared: f64) {
        let sums = &mut self.sums[slot * weighted.len()..][..weighted.len()];
        sums.iter_mut().zip(weighted).for_each(|(sum, value)| *sum += value);
        self.counts[slot] += 1.0;
        self.added[slot] += weight;
        self.inertia += weight * squared;
        self.squared.push(weight * squared);
    }

    fn advance(&mut self, centroids: &mut [f64], dimension: usize) {
        let clusters = centroids.chunks_exact_mut(dimension).zip(self.sums.chunks_exact(dimension));
        for ((centroid, sums), (total, &added)) in clusters.zip(self.weights.iter_mut().zip(&self.added)) {
            if added > 0.0 {
                *total += added;
                let moves = centroid.iter_mut().zip(sums);
                moves.for_each(|(c, sum)| *c += (sum - added * *c) / *total);
            }
        }
    }

    fn reassign(&mut self, centroids: &mut [f64], (batch, weights): (&[f64], &[f64]), dimension: usize) {
        let few = |of: &[f64]| MIN_SHARE * of.iter().copied().fold(0.0, f64::max);
        let (few, few_added) = (few(&self.weights), few(&self.added));
        for slot in 0..self.weights.len() {
            if self.weights[slot] >= few || self.added[slot] >= few_added {
                continue;
            }
            let Some(atom) = self.random.index(&cumulative(self.squared.iter().copied())) else { return };
            let row = &batch[atom * dimension..][..dimension];
            // The next cluster goes elsewhere.
            let distances = batch.chunks_exact(dimension).zip(weights);
            let distances = distances.map(|(other, weight)| weight * squared_distance(other, row));
            self.squared.iter_mut().zip(distances).for_each(|(least, squared)| *least = least.min(squared));
            if let Some(heir) = nearest_other(centroids, slot, dimension) {
                self.counts[heir] += std::mem::take(&mut self.counts[slot]);
                self.weights[heir] += std::mem::take(&mut self.weights[slot]);
            }
            centroids[slot * dimension..][..dimension].copy_from_slice(row);
        }
    }
}

/// The centroid nearest to that of `slot`.
fn nearest_other(centroids: &[f64], slot: usize, dimension: usize) -> Option<usize> {
    let own = &centroids[slot * dimension..][..dimension];
    let others = centroids.chunks_exact(dimension).enumerate().filter(|(other, _)| *other != slot);
    others
        .map(|(other, centroid)| (other, squared_distance(own, centroid)))
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .map(|(other, _)| other)
}
