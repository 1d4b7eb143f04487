//! The global step of pass 1: one set of centroids for each element from the centroids of all shards.

use serde::{Deserialize, Serialize};

use super::elbow::elbow;
use super::error::{BuildError, expect_length, expect_same};
use super::groups::ShardGroups;
use super::mini_batch::{CandidateClusters, ShardClusters};
use super::moments::{ClusterMoments, ComponentSums, merge_small};
use super::settings::BuildSettings;

/// The centroids of an element, about which pass 2 accumulates scatter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ElementPartition {
    /// Element index.
    pub element: usize,
    /// Its atoms in all shards.
    pub atoms: u64,
    /// Weighted within-cluster sum of squares per weight for each candidate K; empty without atoms.
    pub inertia: Vec<f64>,
    /// The candidate K at the elbow; 0 without atoms.
    pub chosen: usize,
    /// Centroids, `[clusters × D]`: at most K, since small clusters are merged; none without atoms.
    pub centroids: Vec<f64>,
    /// Atoms of each cluster, as counted by the shards with their own centroids.
    pub counts: Vec<f64>,
}

/// Combines the clusters that the shards found for an element, one shard after another.
///
/// The elbow of the inertia over all shards chooses K. Weighted k-means (k-means++, Lloyd's algorithm, best of ten
/// runs) of the shards' centroids for this K, with the weights of their atoms, gives the centroids. Clusters with fewer
/// than D + 1 atoms are merged into their nearest neighbour, with **c** = (w_A **c**_A + w_B **c**_B)/(w_A + w_B).
///
/// Memory does not grow with the number of shards: 128 of them at a time, in their order, become a group with at most K
/// centroids in the same way, 128 groups a group of groups, and so on (Guha, Meyerson, Mishra, Motwani & O'Callaghan, IEEE
/// Trans. Knowl. Data Eng. 15, 515 (2003)).
#[derive(Debug, Clone)]
pub struct Partitioner {
    settings: BuildSettings,
    element: usize,
    /// The least index of the next shard.
    next: u64,
    atoms: u64,
    weight: f64,
    /// Σ w |**x** − **c**|² of each candidate.
    inertia: Vec<f64>,
    /// Of each candidate.
    groups: Vec<ShardGroups>,
}

impl Partitioner {
    /// Begins an element.
    ///
    /// # Errors
    /// Invalid settings.
    pub fn new(settings: &BuildSettings, element: usize) -> Result<Self, BuildError> {
        settings.check()?;
        let groups = settings.candidates.iter().map(|&k| ShardGroups::new(settings, element, k));
        Ok(Self {
            element,
            next: 0,
            atoms: 0,
            weight: 0.0,
            inertia: vec![0.0; settings.candidates.len()],
            groups: groups.collect(),
            settings: settings.clone(),
        })
    }

    /// Adds a shard.
    ///
    /// # Errors
    /// A shard that is not behind those before it, or of another element or build. Nothing is added then.
    pub fn add(&mut self, shard: &ShardClusters) -> Result<(), BuildError> {
        self.check(shard)?;
        self.next = shard.shard + 1;
        self.atoms += shard.atoms;
        self.weight += shard.weight;
        for ((found, inertia), groups) in shard.candidates.iter().zip(&mut self.inertia).zip(&mut self.groups)
        {
            *inertia += found.inertia;
            groups.add(found);
        }
        Ok(())
    }

    /// The partition of all shards.
    pub fn finish(mut self) -> ElementPartition {
        let Self { element, atoms, weight, .. } = self;
        if atoms == 0 {
            let (inertia, centroids, counts) = (vec![], vec![], vec![]);
            return ElementPartition { element, atoms, inertia, chosen: 0, centroids, counts };
        }
        let inertia: Vec<f64> = self.inertia.iter().map(|sum| sum / weight).collect();
        let candidates = &self.settings.candidates;
        let chosen = elbow(candidates, &inertia).unwrap_or_default();
        let index = candidates.iter().position(|&k| k == chosen).unwrap_or_default();
        let found = self.groups.swap_remove(index).finish();

        let rows = found.centroids.chunks_exact(self.settings.dimension);
        let numbers = found.counts.into_iter().zip(found.weights);
        let clusters = rows.zip(numbers).map(|(centroid, (count, weight))| cluster(centroid, count, weight));
        let mut merged: Vec<ClusterMoments> = clusters.collect();
        merge_small(&mut merged, self.settings.min_atoms());
        let counts = merged.iter().map(|cluster| cluster.sums.count).collect();
        let centroids = merged.into_iter().flat_map(|cluster| cluster.centroid).collect();
        ElementPartition { element, atoms, inertia, chosen, centroids, counts }
    }

    fn check(&self, shard: &ShardClusters) -> Result<(), BuildError> {
        expect_same("the index of its element", shard.element as u64, self.element as u64)?;
        if shard.shard < self.next {
            return expect_same("its index", shard.shard, self.next);
        }
        let (found, expected) = (shard.candidates.len(), self.settings.candidates.len());
        if shard.atoms > 0 {
            expect_same("the number of candidates", found as u64, expected as u64)?;
        }
        for CandidateClusters { centroids, counts, weights, .. } in &shard.candidates {
            expect_length("centroids of a shard", centroids.len(), counts.len() * self.settings.dimension)?;
            expect_length("weights of a shard", weights.len(), counts.len())?;
        }
        Ok(())
    }
}

fn cluster(centroid: &[f64], count: f64, effective_count: f64) -> ClusterMoments {
    let sums = ComponentSums { count, effective_count, scatter: Vec::new() };
    ClusterMoments { centroid: centroid.to_vec(), sums }
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
            .map(|(centroid, count)| cluster(centroid, count, count))
            .collect();
        let before = clusters.len();
        merge_small(&mut clusters, case["min_atoms"].as_u64().unwrap() as usize);
        assert_eq!(case["n_merged"], before - clusters.len());
        let counts: Vec<f64> = clusters.iter().map(|cluster| cluster.sums.count).collect();
        assert_eq!(counts, numbers("out_counts"));
        let found = clusters.iter().flat_map(|cluster| &cluster.centroid);
        for (found, expected) in found.zip(rows("out_centroids").concat()) {
            assert!((found - expected).abs() < 1e-15, "{found} {expected}");
        }
    }
}
