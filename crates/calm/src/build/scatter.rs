//! Pass 2: counts and scatter of the components of an element in one shard.

use faer::linalg::matmul::triangular::{BlockStructure, matmul};
use faer::{Accum, Mat, Par};

use super::error::BuildError;
use super::moments::{ComponentSums, ElementSums};
use super::sorter::{ComponentBlock, ComponentSorter};
use crate::linear::view;

/// Accumulates, for each component, the number of atoms, Σ w and Σ w **δδ**ᵀ with **δ** = **z** − **μ** about the fixed
/// centroid.
///
/// The scatter of a block of atoms is the matrix product XᵀX of the rows √w **δ**, of which only the lower half is
/// computed. It equals the scatter about the block's own mean, shifted by the parallel-axis theorem, but loses no digits
/// to the shift. The sums depend on the order of the atoms, not on the batches in which they arrive.
#[derive(Debug, Clone)]
pub struct ScatterPass {
    sorter: ComponentSorter,
    sums: ScatterSums,
}

#[derive(Debug, Clone)]
struct ScatterSums {
    dimension: usize,
    components: Vec<(ComponentSums, Mat<f64>)>,
}

impl ScatterPass {
    /// Begins a shard of an element with these centroids, `[K × D]`.
    ///
    /// # Errors
    /// No centroid, or centroids of another dimension.
    pub fn new(dimension: usize, centroids: &[f64]) -> Result<Self, BuildError> {
        let sorter = ComponentSorter::new(dimension, centroids.to_vec())?;
        let empty = || {
            let sums = ComponentSums { count: 0.0, effective_count: 0.0, scatter: Vec::new() };
            (sums, Mat::zeros(dimension, dimension))
        };
        let components = (0..centroids.len() / dimension).map(|_| empty()).collect();
        Ok(Self { sorter, sums: ScatterSums { dimension, components } })
    }

    /// Adds atoms of the element: `features` is `[atoms × D]`, `weights` has one number for each atom.
    ///
    /// # Errors
    /// Wrong lengths, features that are not finite, weights that are negative or not finite. Nothing is added then.
    pub fn add(&mut self, features: &[f64], weights: &[f64]) -> Result<(), BuildError> {
        let Self { sorter, sums } = self;
        sorter.add(features, weights, |slot, block| sums.add(slot, block))
    }

    /// Ends the shard.
    pub fn finish(self) -> ElementSums {
        let Self { sorter, mut sums } = self;
        sorter.finish(|slot, block| sums.add(slot, block));
        let ScatterSums { dimension, components } = sums;
        let packed = components.into_iter().map(|(mut sums, scatter)| {
            sums.scatter = (0..dimension)
                .flat_map(|row| (0..=row).map(move |c| (row, c)))
                .map(|at| scatter[at])
                .collect();
            sums
        });
        ElementSums { dimension, components: packed.collect() }
    }
}

impl ScatterSums {
    fn add(&mut self, slot: usize, block: &mut ComponentBlock) {
        let (sums, scatter) = &mut self.components[slot];
        let rows = block.deltas.chunks_exact_mut(self.dimension).zip(&block.weights);
        for (row, &weight) in rows {
            sums.effective_count += weight;
            if weight != 1.0 {
                let factor = weight.sqrt();
                row.iter_mut().for_each(|value| *value *= factor);
            }
        }
        sums.count += block.weights.len() as f64;
        let rows = view(&block.deltas, block.weights.len(), self.dimension);
        matmul(
            scatter,
            BlockStructure::TriangularLower,
            Accum::Add,
            rows.transpose(),
            BlockStructure::Rectangular,
            rows,
            BlockStructure::Rectangular,
            1.0,
            Par::Seq,
        );
    }
}
