//! The global step of pass 1: one set of centroids for each element from the centroids of all shards.

use serde::{Deserialize, Serialize};

use super::elbow::elbow;
use super::error::{BuildError, expect_length, expect_same};
use super::kmeans::{Points, weighted_kmeans};
use super::mini_batch::ShardClusters;
use super::moments::{ComponentSums, Moments, merge_small};
use super::random::Random;
use super::settings::BuildSettings;

/// Stands for all shards among the words that choose random numbers.
const ALL_SHARDS: u64 = u64::MAX;

/// The centroids of an element, about which pass 2 accumulates scatter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ElementPartition {
    /// Element index.
    pub element: usize,
    /// Its atoms in all shards.
    pub atoms: u64,
    /// Within-cluster sum of squares per atom for each candidate K; empty without atoms.
    pub inertia: Vec<f64>,
    /// The candidate K at the elbow; 0 without atoms.
    pub chosen: usize,
    /// Centroids, `[clusters × D]`: at most K, since small clusters are merged; none without atoms.
    pub centroids: Vec<f64>,
    /// Atoms of each cluster, as counted by the shards with their own centroids.
    pub counts: Vec<f64>,
}

/// Combines the clusters that the shards found for an element.
///
/// The elbow of the inertia over all shards chooses K. Weighted k-means (k-means++, Lloyd's algorithm, best of ten
/// runs) of the shards' centroids for this K, with their counts as weights, gives the centroids. Clusters with fewer
/// than D + 1 atoms are merged into their nearest neighbour, with **c** = (n_A **c**_A + n_B **c**_B)/(n_A + n_B).
///
/// # Errors
/// Invalid settings; shards that are not in ascending order, or of another element or build.
pub fn partition(
    settings: &BuildSettings,
    element: usize,
    shards: &[ShardClusters],
) -> Result<ElementPartition, BuildError> {
    settings.check()?;
    check(settings, element, shards)?;
    let filled = || shards.iter().filter(|shard| shard.atoms > 0);
    let atoms: u64 = filled().map(|shard| shard.atoms).sum();
    if atoms == 0 {
        let (inertia, centroids, counts) = (vec![], vec![], vec![]);
        return Ok(ElementPartition { element, atoms, inertia, chosen: 0, centroids, counts });
    }
    let total = |k: usize| filled().map(|shard| shard.candidates[k].inertia).sum::<f64>();
    let inertia: Vec<f64> = (0..settings.candidates.len()).map(|k| total(k) / atoms as f64).collect();
    let chosen = elbow(&settings.candidates, &inertia).unwrap_or_default();
    let index = settings.candidates.iter().position(|&k| k == chosen).unwrap_or_default();

    let clusters = || filled().map(|shard| &shard.candidates[index]);
    let features: Vec<f64> = clusters().flat_map(|found| found.centroids.iter().copied()).collect();
    let weights: Vec<f64> = clusters().flat_map(|found| found.counts.iter().copied()).collect();
    let points = Points { dimension: settings.dimension, features: &features, weights: &weights };
    let mut random = Random::new(&[settings.seed, ALL_SHARDS, element as u64, chosen as u64]);
    let found = weighted_kmeans(&points, chosen, &mut random);

    let rows = found.centroids.chunks_exact(settings.dimension).zip(found.counts);
    let mut merged: Vec<Moments> = rows.map(|(centroid, count)| populated(centroid, count)).collect();
    merge_small(&mut merged, settings.min_atoms());
    let counts = merged.iter().map(|cluster| cluster.sums.count).collect();
    let centroids = merged.into_iter().flat_map(|cluster| cluster.centroid).collect();
    Ok(ElementPartition { element, atoms, inertia, chosen, centroids, counts })
}

fn populated(centroid: &[f64], count: f64) -> Moments {
    let sums = ComponentSums { count, effective_count: count, scatter: Vec::new() };
    Moments { centroid: centroid.to_vec(), sums }
}

fn check(settings: &BuildSettings, element: usize, shards: &[ShardClusters]) -> Result<(), BuildError> {
    let mut next = 0;
    for shard in shards {
        expect_same("the index of its element", shard.element as u64, element as u64)?;
        if shard.shard < next {
            return expect_same("its index", shard.shard, next);
        }
        next = shard.shard + 1;
        if shard.atoms == 0 {
            continue;
        }
        let (found, expected) = (shard.candidates.len(), settings.candidates.len());
        expect_same("the number of candidates", found as u64, expected as u64)?;
        for clusters in &shard.candidates {
            let expected = clusters.counts.len() * settings.dimension;
            expect_length("centroids of a shard", clusters.centroids.len(), expected)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::build::tests::unit_cases;

    #[test]
    fn small_clusters_merge_as_in_the_reference() {
        let case = &unit_cases()["merge_small_clusters"];
        let numbers = |key: &str| serde_json::from_value::<Vec<f64>>(case[key].clone()).unwrap();
        let rows = |key: &str| serde_json::from_value::<Vec<Vec<f64>>>(case[key].clone()).unwrap();
        let clusters = rows("centroids");
        let mut clusters: Vec<_> = clusters
            .iter()
            .zip(numbers("counts"))
            .map(|(centroid, count)| populated(centroid, count))
            .collect();
        merge_small(&mut clusters, case["min_atoms"].as_u64().unwrap() as usize);
        let counts: Vec<f64> = clusters.iter().map(|cluster| cluster.sums.count).collect();
        assert_eq!(counts, numbers("out_counts"));
        let found = clusters.iter().flat_map(|cluster| &cluster.centroid);
        for (found, expected) in found.zip(rows("out_centroids").concat()) {
            assert!((found - expected).abs() < 1e-15, "{found} {expected}");
        }
    }
}
