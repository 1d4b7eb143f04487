//! Sorts the atoms of a stream into blocks by their nearest centroid, so that one matrix product serves many of them.

use super::distances::{CentroidDistances, check};
use super::error::{BuildError, expect_weights};
use super::settings::check_dimension;

/// Atoms of a block: enough for a matrix product to reach its full rate, few enough for the second-level cache.
pub(super) const BLOCK_ATOMS: usize = 128;

/// The blocks of one element.
#[derive(Debug, Clone)]
pub(super) struct ComponentSorter {
    distances: CentroidDistances,
    blocks: Vec<ComponentBlock>,
}

/// Atoms that wait for the product of their component.
#[derive(Debug, Clone, Default)]
pub(super) struct ComponentBlock {
    /// **δ** = **z** − **μ**, `[atoms × D]`.
    pub deltas: Vec<f64>,
    /// Weights of the atoms.
    pub weights: Vec<f64>,
}

impl ComponentSorter {
    /// Centroids, `[K × D]`.
    pub fn new(dimension: usize, centroids: Vec<f64>) -> Result<Self, BuildError> {
        check_dimension(dimension)?;
        let count = check(&centroids, dimension, &mut Vec::new())?;
        if count == 0 {
            return Err(BuildError::NoCentroid);
        }
        Ok(Self {
            distances: CentroidDistances::new(dimension, centroids),
            blocks: vec![ComponentBlock::default(); count],
        })
    }

    /// Adds atoms and calls `full` with the index of the component for each block that is full.
    ///
    /// Blocks depend only on the order of the atoms, not on the batches in which they arrive.
    pub fn add(
        &mut self,
        features: &[f64],
        weights: &[f64],
        mut full: impl FnMut(usize, &mut ComponentBlock),
    ) -> Result<(), BuildError> {
        let atoms = self.distances.check(features)?;
        expect_weights(weights, atoms)?;
        let Self { distances, blocks } = self;
        distances.for_each_checked_chunk(features, |chunk| {
            for (atom, row) in chunk.rows().enumerate() {
                let slot = chunk.assigned(atom);
                let block = &mut blocks[slot];
                block.push(row, chunk.centroid(slot), weights[chunk.first + atom]);
                if block.weights.len() == BLOCK_ATOMS {
                    full(slot, block);
                    block.clear();
                }
            }
        });
        Ok(())
    }

    /// Calls `rest` with each block that has atoms left.
    pub fn finish(self, mut rest: impl FnMut(usize, &mut ComponentBlock)) {
        let left = self.blocks.into_iter().enumerate().filter(|(_, block)| !block.weights.is_empty());
        left.for_each(|(slot, mut block)| rest(slot, &mut block));
    }
}

impl ComponentBlock {
    fn push(&mut self, row: &[f64], centroid: &[f64], weight: f64) {
        if self.weights.capacity() == 0 {
            self.deltas.reserve_exact(BLOCK_ATOMS * row.len());
            self.weights.reserve_exact(BLOCK_ATOMS);
        }
        self.deltas.extend(row.iter().zip(centroid).map(|(z, centre)| z - centre));
        self.weights.push(weight);
    }

    fn clear(&mut self) {
        self.deltas.clear();
        self.weights.clear();
    }
}
