//! Counts and scatter of clusters about their centroids, and the merging of clusters with too few atoms.

use serde::{Deserialize, Serialize};

use super::error::{BuildError, expect_length, expect_same};
use crate::linear::squared_distance;

/// Counts and scatter of the atoms of one component about its fixed centroid.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ComponentSums {
    /// Number of atoms.
    pub count: f64,
    /// Sum of their weights.
    pub effective_count: f64,
    /// Lower half of Σ w **δδ**ᵀ row by row, `[D (D + 1) / 2]`.
    pub scatter: Vec<f64>,
}

/// The sums of all components of an element, of one shard or of all shards up to one. Serialisable.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ElementSums {
    /// Feature dimension D.
    pub dimension: usize,
    /// In the order of the centroids.
    pub components: Vec<ComponentSums>,
}

impl ElementSums {
    /// All numbers in one row, for [`ExactSums`](super::ExactSums).
    pub fn to_row(&self) -> Vec<f64> {
        let numbers = |sums: &ComponentSums| {
            let mut numbers = vec![sums.count, sums.effective_count];
            numbers.extend(&sums.scatter);
            numbers
        };
        self.components.iter().flat_map(numbers).collect()
    }

    /// The sums from their row, which has a whole number of components.
    ///
    /// # Errors
    /// A row of another length.
    pub fn from_row(dimension: usize, row: &[f64]) -> Result<Self, BuildError> {
        let length = 2 + dimension * (dimension + 1) / 2;
        expect_length("sums of an element", row.len(), row.len().next_multiple_of(length))?;
        let components = row.chunks_exact(length).map(|numbers| ComponentSums {
            count: numbers[0],
            effective_count: numbers[1],
            scatter: numbers[2..].to_vec(),
        });
        Ok(Self { dimension, components: components.collect() })
    }

    /// Adds the sums of the next shard.
    ///
    /// Rounding depends on the order: add each shard's own sums, in the order of the shards, and the result does not
    /// depend on which worker had which shard.
    ///
    /// # Errors
    /// Sums of another number of components or features. Nothing is added then.
    pub fn merge(&mut self, next: &Self) -> Result<(), BuildError> {
        let (found, expected) = (next.components.len(), self.components.len());
        expect_same("the number of components", found as u64, expected as u64)?;
        for (sums, next) in self.components.iter().zip(&next.components) {
            expect_same("the length of a scatter", next.scatter.len() as u64, sums.scatter.len() as u64)?;
        }
        for (sums, next) in self.components.iter_mut().zip(&next.components) {
            sums.count += next.count;
            sums.effective_count += next.effective_count;
            sums.scatter.iter_mut().zip(&next.scatter).for_each(|(sum, value)| *sum += value);
        }
        Ok(())
    }
}

/// A cluster that can be merged.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ClusterMoments {
    pub centroid: Vec<f64>,
    /// The scatter is empty if only centroids are of interest.
    pub sums: ComponentSums,
}

impl ClusterMoments {
    /// Takes over the atoms of another cluster, by the parallel-axis theorem:
    ///
    /// **μ** = (n_A **μ**_A + n_B **μ**_B) / n,  S = S_A + S_B + n_A n_B / n **dd**ᵀ,
    ///
    /// with **d** = **μ**_A − **μ**_B, n = n_A + n_B, and the effective counts n_A and n_B. A cluster without weight
    /// moves nothing.
    fn join(&mut self, other: Self) {
        let (own, added) = (self.sums.effective_count, other.sums.effective_count);
        let total = own + added;
        let (to, from) = if total > 0.0 { (own / total, added / total) } else { (1.0, 0.0) };
        let d: Vec<f64> = self.centroid.iter().zip(&other.centroid).map(|(a, b)| a - b).collect();
        let lower = (0..d.len()).flat_map(|row| (0..=row).map(move |column| (row, column)));
        let scatter = self.sums.scatter.iter_mut().zip(&other.sums.scatter);
        for ((sum, value), (row, column)) in scatter.zip(lower) {
            *sum += value + own * from * d[row] * d[column];
        }
        let centroid = self.centroid.iter_mut().zip(&other.centroid);
        centroid.for_each(|(a, b)| *a = to * *a + from * b);
        self.sums.count += other.sums.count;
        self.sums.effective_count = total;
    }
}

/// Merges clusters with fewer than `min_atoms` atoms (paper, Methods): the smallest first, into the one with the
/// nearest centroid, until none or only one cluster is left. The others keep their order.
pub(super) fn merge_small(clusters: &mut Vec<ClusterMoments>, min_atoms: usize) {
    while clusters.len() > 1 {
        let count = |slot: &usize| clusters[*slot].sums.count;
        let smallest = (0..clusters.len()).min_by(|a, b| count(a).total_cmp(&count(b)));
        let Some(smallest) = smallest.filter(|slot| count(slot) < min_atoms as f64) else { return };
        let removed = clusters.remove(smallest);
        let distance = |of: &ClusterMoments| squared_distance(&of.centroid, &removed.centroid);
        let nearest = clusters.iter_mut().min_by(|a, b| distance(a).total_cmp(&distance(b)));
        if let Some(nearest) = nearest {
            nearest.join(removed);
        }
    }
}
