//! k-means of the centroids of any number of shards in bounded memory.

use super::kmeans::{Clusters, WeightedPoints, weighted_kmeans};
use super::mini_batch::CandidateClusters;
use super::random::Random;
use super::settings::BuildSettings;

/// Shards that become one group, and groups that become one of the next level.
const MEMBERS: usize = 128;

/// Stands for all shards among the words that choose random numbers.
const ALL_SHARDS: u64 = u64::MAX;

/// The clusters of shards for one K, of groups of shards, of groups of groups, …
#[derive(Debug, Clone)]
pub(super) struct ShardGroups {
    dimension: usize,
    k: usize,
    /// Random seed, all shards, element and K.
    words: [u64; 4],
    levels: Vec<Level>,
}

/// The clusters of what waits to become a group.
#[derive(Debug, Clone, Default)]
struct Level {
    members: usize,
    /// Groups made before.
    groups: u64,
    clusters: Clusters,
}

impl ShardGroups {
    pub fn new(settings: &BuildSettings, element: usize, k: usize) -> Self {
        let words = [settings.seed, ALL_SHARDS, element as u64, k as u64];
        Self { dimension: settings.dimension, k, words, levels: Vec::new() }
    }

    /// Adds a shard.
    pub fn add(&mut self, shard: &CandidateClusters) {
        let CandidateClusters { centroids, counts, weights, .. } = shard;
        let mut next = Clusters {
            centroids: centroids.clone(),
            counts: counts.clone(),
            weights: weights.clone(),
            inertia: 0.0,
        };
        for number in 0.. {
            if self.levels.len() == number {
                self.levels.push(Level::default());
            }
            let level = &mut self.levels[number];
            level.members += 1;
            level.clusters.append(next);
            if level.members < MEMBERS {
                return;
            }
            let words = [&self.words[..], &[number as u64, level.groups]].concat();
            let group =
                weighted_kmeans(&points(self.dimension, &level.clusters), self.k, &mut Random::new(&words));
            *level = Level { groups: level.groups + 1, ..Level::default() };
            next = group;
        }
    }

    /// The clusters of all shards.
    pub fn finish(self) -> Clusters {
        let mut all = Clusters::default();
        // The groups hold the first shards.
        self.levels.into_iter().rev().for_each(|level| all.append(level.clusters));
        weighted_kmeans(&points(self.dimension, &all), self.k, &mut Random::new(&self.words))
    }
}

impl Clusters {
    fn append(&mut self, other: Self) {
        self.centroids.extend(other.centroids);
        self.counts.extend(other.counts);
        self.weights.extend(other.weights);
    }
}

fn points(dimension: usize, clusters: &Clusters) -> WeightedPoints<'_> {
    let Clusters { centroids, counts, weights, .. } = clusters;
    WeightedPoints { dimension, features: centroids, weights, counts }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_bounded_and_nothing_is_lost() {
        let settings = BuildSettings { dimension: 2, seed: 1, candidates: vec![3], shard_size: 1 };
        let mut groups = ShardGroups::new(&settings, 0, 3);
        let mut random = Random::new(&[5]);
        let shards = 2 * MEMBERS * MEMBERS + 3 * MEMBERS + 5;
        let mut weight = 0.0;
        for shard in 0..shards {
            let centroids: Vec<f64> =
                (0..3).flat_map(|blob| [10.0 * blob as f64 + random.uniform(), random.uniform()]).collect();
            let weights = vec![0.5, 1.0 + (shard % 3) as f64, 2.0];
            weight += weights.iter().sum::<f64>();
            groups.add(&CandidateClusters { centroids, counts: vec![1.0; 3], weights, inertia: 0.0 });
            assert!(groups.levels.iter().all(|level| level.clusters.counts.len() <= 3 * MEMBERS));
        }
        let members: Vec<usize> = groups.levels.iter().map(|level| level.members).collect();
        assert_eq!(members, [5, 3, 2]);
        let found = groups.finish();
        assert_eq!(found.counts, [shards as f64; 3]);
        assert_eq!(found.weights.iter().sum::<f64>(), weight);
        for (centroid, blob) in found.centroids.chunks_exact(2).zip(blobs(&found.centroids)) {
            // The mean of the blob, within five standard deviations of that of uniform numbers.
            let tolerance = 5.0 / (12.0 * shards as f64).sqrt();
            assert!(
                (centroid[0] - 10.0 * blob - 0.5).abs() < tolerance && (centroid[1] - 0.5).abs() < tolerance
            );
        }
    }

    /// The blob of each centroid; all differ.
    fn blobs(centroids: &[f64]) -> Vec<f64> {
        let blobs: Vec<f64> =
            centroids.chunks_exact(2).map(|centroid| (centroid[0] / 10.0).floor()).collect();
        let mut all = blobs.clone();
        all.sort_by(f64::total_cmp);
        assert_eq!(all, [0.0, 1.0, 2.0]);
        blobs
    }
}
