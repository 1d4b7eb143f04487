//! k-means of the centroids of any number of shards in bounded memory.

use super::kmeans::{Clusters, Points, weighted_kmeans};
use super::mini_batch::CandidateClusters;
use super::random::Random;
use super::settings::BuildSettings;

/// Shards that become one group, and groups that become one of the next level.
const MEMBERS: usize = 128;

/// Stands for all shards among the words that choose random numbers.
const ALL_SHARDS: u64 = u64::MAX;

/// The clusters of shards for one K, of groups of shards, of groups of groups, …
#[derive(Debug, Clone)]
pub(super) struct Groups {
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

impl Groups {
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
            let group = weighted_kmeans(&points(self.dimension, &level.clusters), self.k, &mut Random::new(&words));
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

fn points(dimension: usize, clusters: &Clusters) -> Points<'_> {
    let Clusters { centroids, counts, weights, .. } = clusters;
    Points { dimension, features: centroids, weights, counts }
}
