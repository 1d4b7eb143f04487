//! Pass 3: histograms of σ of the components of an element in one shard.

use faer::linalg::matmul::matmul;
use faer::prelude::ReborrowMut;
use faer::{Accum, MatMut, Par};

use super::components::BuiltComponent;
use super::error::{BuildError, expect_length};
use super::histogram::{BinEdges, ElementHistograms};
use super::sorter::{BLOCK_ATOMS, ComponentBlock, ComponentSorter};
use crate::grade::DISTANCE_FLOOR;
use crate::linear::{row_dots, view};

/// Columns of the triangle that one matrix product gives: enough to be fast, few enough to skip most of the zeros.
const PANEL: usize = 66;

/// Fills, for each component, the raw and the weighted histogram of σ = √(**δ**ᵀS**δ** + 10⁻⁸). S is symmetric, so
/// **δ**ᵀS**δ** = **δ**ᵀT**δ** with its upper triangle T, T_ij = 2 S_ij for i < j and T_ii = S_ii. Tᵀ**δ** of a block of atoms is
/// one matrix product for each panel of columns, over the rows down to the diagonal. The histograms depend on the order of the
/// atoms, not on the batches in which they arrive.
#[derive(Debug, Clone)]
pub struct CalibrationPass {
    sorter: ComponentSorter,
    sums: CalibrationSums,
}

#[derive(Debug, Clone)]
struct CalibrationSums {
    dimension: usize,
    grid: BinEdges,
    /// T of each component, `[D × D]`.
    triangles: Vec<Vec<f64>>,
    /// Tᵀ**δ** of the atoms of a block.
    products: Vec<f64>,
    /// **δ**ᵀS**δ** of each.
    squared: Vec<f64>,
    histograms: ElementHistograms,
}

impl CalibrationPass {
    /// Begins a shard of an element with these components.
    ///
    /// # Errors
    /// No component; centroids or inverses of unequal dimensions.
    pub fn new(components: &[BuiltComponent]) -> Result<Self, BuildError> {
        let dimension = components.first().map_or(0, |component| component.centroid.len());
        for component in components {
            expect_length("centroid", component.centroid.len(), dimension)?;
            expect_length("inverse covariance", component.inverse.len(), dimension * dimension)?;
        }
        let centroids = components.iter().flat_map(|component| &component.centroid).copied().collect();
        let sums = CalibrationSums {
            dimension,
            grid: BinEdges::default(),
            triangles: components.iter().map(|component| triangle(&component.inverse, dimension)).collect(),
            products: vec![0.0; BLOCK_ATOMS * dimension],
            squared: Vec::with_capacity(BLOCK_ATOMS),
            histograms: ElementHistograms::empty(components.len()),
        };
        Ok(Self { sorter: ComponentSorter::new(dimension, centroids)?, sums })
    }

    /// Adds atoms of the element: `features` is `[atoms × D]`, `weights` has one number for each atom.
    ///
    /// # Errors
    /// As [`super::ScatterPass::add`].
    pub fn add(&mut self, features: &[f64], weights: &[f64]) -> Result<(), BuildError> {
        let Self { sorter, sums } = self;
        sorter.add(features, weights, |slot, block| sums.add(slot, block))
    }

    /// Ends the shard.
    pub fn finish(self) -> ElementHistograms {
        let Self { sorter, mut sums } = self;
        sorter.finish(|slot, block| sums.add(slot, block));
        sums.histograms
    }
}

impl CalibrationSums {
    fn add(&mut self, slot: usize, block: &ComponentBlock) {
        let (atoms, dimension) = (block.weights.len(), self.dimension);
        let products = &mut self.products[..atoms * dimension];
        let mut out = MatMut::from_row_major_slice_mut(&mut *products, atoms, dimension);
        let deltas = view(&block.deltas, atoms, dimension);
        let triangle = view(&self.triangles[slot], dimension, dimension);
        for first in (0..dimension).step_by(PANEL) {
            let columns = PANEL.min(dimension - first);
            let panel = triangle.submatrix(0, first, first + columns, columns);
            let deltas = deltas.subcols(0, first + columns);
            let out = out.rb_mut().subcols_mut(first, columns);
            matmul(out, Accum::Replace, deltas, panel, 1.0, Par::Seq);
        }
        let histogram = &mut self.histograms.components[slot];
        row_dots(&block.deltas, products, dimension, &mut self.squared);
        for (squared, weight) in self.squared.iter().zip(&block.weights) {
            let sigma = (squared.max(0.0) + DISTANCE_FLOOR).sqrt();
            let bin = self.grid.bin(sigma);
            histogram.raw[bin] += 1;
            histogram.weighted[bin] += weight;
        }
    }
}

/// The upper triangle T of a symmetric matrix S with **δ**ᵀT**δ** = **δ**ᵀS**δ**, `[D × D]`.
fn triangle(matrix: &[f64], dimension: usize) -> Vec<f64> {
    let mut triangle = vec![0.0; dimension * dimension];
    for row in 0..dimension {
        triangle[row * dimension + row] = matrix[row * dimension + row];
        for column in row + 1..dimension {
            triangle[row * dimension + column] =
                matrix[row * dimension + column] + matrix[column * dimension + row];
        }
    }
    triangle
}
