//! MaxVol for a stream of rows: a set of rows of largest volume, in whose terms every other row is expressed.
//!
//! The rows of the active matrix A, `[r × D]`, are such that the coefficients **c** = **x** A⁺ of all rows that were
//! seen are at most 1 + tolerance in magnitude (Goreinov et al., in Matrix Methods, 2010; Podryabinkin & Shapeev, Comput.
//! Mater. Sci. 140, 171, 2017). Replacing row j of A by **x** multiplies the volume by |c_j|, so sweeps end.
//!
//! Rows may span fewer than D dimensions. The active rows therefore have an orthonormal basis Q of their span: the set
//! grows by the row that reaches furthest out of it, until none does by more than rounding. Then A⁺ = Q(AQᵀ)⁻¹, which is
//! A⁻¹ for r = D.

use faer::linalg::matmul::matmul;
use faer::linalg::solvers::{DenseSolveCore, PartialPivLu};
use faer::{Accum, MatMut, Par};

use crate::linear::{dot, product, row_dots, view};

/// Active rows of one group of atoms.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ActiveSet {
    dimension: usize,
    /// A, `[r × D]`.
    rows: Vec<f64>,
    /// Q, `[r × D]`.
    basis: Vec<f64>,
    /// (A⁺)ᵀ, `[r × D]`.
    coefficients: Vec<f64>,
    /// The largest norm of a row.
    largest: f64,
    /// Exchanged rows since A⁺ was last computed anew.
    exchanges: usize,
    /// Whether A changed in this sweep.
    changed: bool,
}

/// What MaxVol is to reach.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Tolerances {
    /// Of coefficients above 1.
    pub coefficient: f64,
    /// Of rows outside the span, times the largest norm.
    pub rank: f64,
}

impl ActiveSet {
    /// An empty set.
    pub fn new(dimension: usize) -> Self {
        let (rows, basis, coefficients) = (Vec::new(), Vec::new(), Vec::new());
        Self { dimension, rows, basis, coefficients, largest: 0.0, exchanges: 0, changed: false }
    }

    /// A set that was stored: A and (A⁺)ᵀ, `[r × D]`. It can score, not grow.
    pub fn from_parts(dimension: usize, rows: Vec<f64>, coefficients: Vec<f64>) -> Self {
        Self { rows, coefficients, ..Self::new(dimension) }
    }

    /// r, the number of active rows.
    pub fn rank(&self) -> usize {
        self.rows.len() / self.dimension
    }

    /// A, `[r × D]`.
    pub fn rows(&self) -> &[f64] {
        &self.rows
    }

    /// (A⁺)ᵀ, `[r × D]`.
    pub fn coefficients(&self) -> &[f64] {
        &self.coefficients
    }

    /// max_j |(**x** A⁺)_j| of each row **x**, `[n × D]`; ∞ for an empty set.
    pub fn score(&self, rows: &[f64]) -> Vec<f64> {
        let count = rows.len() / self.dimension;
        if self.rank() == 0 {
            return vec![f64::INFINITY; count];
        }
        let coefficients = multiply_transposed(rows, &self.coefficients, self.dimension);
        let largest = |row: &[f64]| row.iter().fold(0.0, |largest: f64, c| largest.max(c.abs()));
        coefficients.chunks_exact(self.rank()).map(largest).collect()
    }

    /// Takes a block of rows, `[n × D]`, into account.
    pub fn visit(&mut self, block: &[f64], tolerances: Tolerances) {
        let mut lengths = Vec::new();
        row_dots(block, block, self.dimension, &mut lengths);
        self.largest = lengths.iter().fold(self.largest, |largest, length| largest.max(length.sqrt()));
        self.grow(block, tolerances.rank);
        self.exchange(block, tolerances.coefficient);
    }

    /// Adds the rows that reach out of the span, the furthest first.
    fn grow(&mut self, block: &[f64], tolerance: f64) {
        let dimension = self.dimension;
        if self.rank() == dimension {
            return;
        }
        let mut outside = block.to_vec();
        if self.rank() > 0 {
            let along = multiply_transposed(block, &self.basis, dimension);
            let (count, rank) = (block.len() / dimension, self.rank());
            let out = MatMut::from_row_major_slice_mut(&mut outside, count, dimension);
            let (along, basis) = (view(&along, count, rank), view(&self.basis, rank, dimension));
            matmul(out, Accum::Add, along, basis, -1.0, Par::Seq);
        }
        let mut squares = Vec::new();
        while self.rank() < dimension {
            row_dots(&outside, &outside, dimension, &mut squares);
            let Some((index, square)) = first_largest(&squares) else { return };
            if square.sqrt() <= tolerance * self.largest {
                return;
            }
            let row = &block[index * dimension..][..dimension];
            let Some(direction) = self.append(row, tolerance) else {
                // Rounding left more of the row than there is.
                outside[index * dimension..][..dimension].fill(0.0);
                continue;
            };
            for row in outside.chunks_exact_mut(dimension) {
                let along = dot(row, &direction);
                row.iter_mut().zip(&direction).for_each(|(x, q)| *x -= along * q);
            }
        }
    }

    /// Adds a row to A and the direction in which it leaves the span to Q; returns the direction. `None` if it leaves by no more
    /// than rounding.
    fn append(&mut self, row: &[f64], tolerance: f64) -> Option<Vec<f64>> {
        let mut direction = row.to_vec();
        // Twice is enough (Parlett, The Symmetric Eigenvalue Problem, 1980).
        for _ in 0..2 {
            for q in self.basis.chunks_exact(self.dimension) {
                let along = dot(&direction, q);
                direction.iter_mut().zip(q).for_each(|(x, q)| *x -= along * q);
            }
        }
        let length = dot(&direction, &direction).sqrt();
        if length <= tolerance * self.largest {
            return None;
        }
        direction.iter_mut().for_each(|x| *x /= length);
        for coefficients in self.coefficients.chunks_exact_mut(self.dimension) {
            let factor = dot(row, coefficients) / length;
            coefficients.iter_mut().zip(&direction).for_each(|(c, q)| *c -= factor * q);
        }
        self.coefficients.extend(direction.iter().map(|q| q / length));
        self.rows.extend_from_slice(row);
        self.basis.extend_from_slice(&direction);
        self.changed = true;
        Some(direction)
    }

    /// Exchanges active rows for rows of the block until no coefficient exceeds 1 + tolerance.
    fn exchange(&mut self, block: &[f64], tolerance: f64) {
        let rank = self.rank();
        if rank == 0 {
            return;
        }
        let mut coefficients = multiply_transposed(block, &self.coefficients, self.dimension);
        while let Some((place, largest)) = first_largest_magnitude(&coefficients) {
            if largest <= 1.0 + tolerance {
                return;
            }
            let (index, slot) = (place / rank, place % rank);
            self.replace(slot, &block[index * self.dimension..][..self.dimension]);
            if self.exchanges == 0 {
                coefficients = multiply_transposed(block, &self.coefficients, self.dimension);
                continue;
            }
            let mut change = coefficients[index * rank..][..rank].to_vec();
            let pivot = change[slot];
            change[slot] -= 1.0;
            for row in coefficients.chunks_exact_mut(rank) {
                let factor = row[slot] / pivot;
                row.iter_mut().zip(&change).for_each(|(c, change)| *c -= factor * change);
            }
        }
    }

    /// Replaces an active row; A⁺ changes by a matrix of rank 1.
    fn replace(&mut self, slot: usize, row: &[f64]) {
        let dimension = self.dimension;
        self.rows[slot * dimension..][..dimension].copy_from_slice(row);
        self.changed = true;
        self.exchanges += 1;
        if self.exchanges >= self.rank() {
            return self.refresh();
        }
        let along: Vec<f64> = self.coefficients.chunks_exact(dimension).map(|c| dot(row, c)).collect();
        let of_slot: Vec<f64> =
            self.coefficients[slot * dimension..][..dimension].iter().map(|c| c / along[slot]).collect();
        for (other, coefficients) in self.coefficients.chunks_exact_mut(dimension).enumerate() {
            if other == slot {
                coefficients.copy_from_slice(&of_slot);
            } else {
                let along = along[other];
                coefficients.iter_mut().zip(&of_slot).for_each(|(c, s)| *c -= along * s);
            }
        }
    }

    /// Computes A⁺ = Qᵀ(AQᵀ)⁻¹ anew, without the rounding of many changes.
    fn refresh(&mut self) {
        self.exchanges = 0;
        let (rank, dimension) = (self.rank(), self.dimension);
        if rank == 0 {
            return;
        }
        let (rows, basis) = (view(&self.rows, rank, dimension), view(&self.basis, rank, dimension));
        let inverse = PartialPivLu::new(product(rows, basis.transpose()).as_ref()).inverse();
        let mut out = MatMut::from_row_major_slice_mut(&mut self.coefficients, rank, dimension);
        matmul(&mut out, Accum::Replace, inverse.transpose(), basis, 1.0, Par::Seq);
    }

    /// Ends a sweep over all rows. Returns whether A changed in it.
    pub fn end_sweep(&mut self) -> bool {
        self.refresh();
        std::mem::take(&mut self.changed)
    }
}

/// X Yᵀ of `[n × D]` and `[m × D]`, `[n × m]`.
pub(super) fn multiply_transposed(left: &[f64], right: &[f64], dimension: usize) -> Vec<f64> {
    let (n, m) = (left.len() / dimension, right.len() / dimension);
    let mut out = vec![0.0; n * m];
    let target = MatMut::from_row_major_slice_mut(&mut out, n, m);
    matmul(
        target,
        Accum::Replace,
        view(left, n, dimension),
        view(right, m, dimension).transpose(),
        1.0,
        Par::Seq,
    );
    out
}

/// Index and value of the largest number, the first of several.
fn first_largest(numbers: &[f64]) -> Option<(usize, f64)> {
    let mut best = None;
    for (index, &number) in numbers.iter().enumerate() {
        if best.is_none_or(|(_, largest)| number > largest) {
            best = Some((index, number));
        }
    }
    best
}

/// The same of magnitudes.
fn first_largest_magnitude(numbers: &[f64]) -> Option<(usize, f64)> {
    let largest = numbers.iter().fold(0.0, |largest: f64, x| largest.max(x.abs()));
    numbers.iter().position(|x| x.abs() == largest).map(|index| (index, largest))
}
