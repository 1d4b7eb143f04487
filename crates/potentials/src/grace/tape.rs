//! The equivariant tensors of one atom, and the operations that make one from others.
//!
//! All tensors of an atom stand behind one another on a tape, each \[component\]\[channel\]. An operation
//! reads rows that stand before its result. Cotangents stand on a second tape of the same layout, which
//! the operations walk backwards.

use super::equivariant_norm::EquivariantNorm;
use super::matrix::{Lanes, add_scaled};
use super::product::{Combination, Product};
use super::weights::Weights;

/// Where a tensor stands on the tape.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tensor {
    /// First lane.
    pub start: usize,
    /// Number of angular components.
    pub components: usize,
    /// Number of channels without padding.
    pub channels: usize,
    /// Lanes of one component.
    pub width: usize,
}

impl Tensor {
    /// First lane of a component.
    pub fn row(&self, component: usize) -> usize {
        self.start + component * self.width
    }

    /// One lane past the tensor.
    pub fn end(&self) -> usize {
        self.start + self.components * self.width
    }
}

/// One step along the tape.
#[derive(Clone, Debug)]
pub(super) enum Operation {
    /// Channels mixed with weights.
    Linear(Linear),
    /// Components coupled, channel by channel.
    Product(Product),
    /// Components summed with factors.
    Combination(Combination),
    /// Components divided by their norm.
    EquivariantNorm(EquivariantNorm),
}

impl Operation {
    /// `element` is that of the atom.
    #[inline(always)]
    pub fn forward(&self, element: usize, tape: &mut [Lanes]) {
        match self {
            Self::Linear(linear) => linear.forward(element, tape),
            Self::Product(product) => product.forward(tape),
            Self::Combination(combination) => combination.forward(tape),
            Self::EquivariantNorm(norm) => norm.forward(tape),
        }
    }

    /// Adds to the cotangents of what it read.
    #[inline(always)]
    pub fn backward(&self, element: usize, tape: &[Lanes], cotangent: &mut [Lanes]) {
        match self {
            Self::Linear(linear) => linear.backward(element, cotangent),
            Self::Product(product) => product.backward(tape, cotangent),
            Self::Combination(combination) => combination.backward(cotangent),
            Self::EquivariantNorm(norm) => norm.backward(tape, cotangent),
        }
    }

    /// Drops every result that nobody needs, and marks as needed what the others read;
    /// `needed` says it for each lane of the tape at which a row begins.
    pub fn keep(&mut self, needed: &mut [bool]) {
        match self {
            Self::Linear(linear) => linear.keep(needed),
            Self::Product(product) => product.keep(needed),
            Self::Combination(combination) => combination.keep(needed),
            Self::EquivariantNorm(norm) => norm.keep(needed),
        }
    }
}

/// out_k,w = Σ over parts, Σ_n W_kn x_n,w′.
#[derive(Clone, Debug)]
pub(super) struct Linear {
    /// First lane of the result.
    pub start: usize,
    /// Rows that share weights.
    pub parts: Vec<LinearPart>,
}

/// Rows of one or more tensors multiplied by the same weights.
#[derive(Clone, Debug)]
pub(super) struct LinearPart {
    /// [n_in × n_out]
    pub weights: Weights,
    /// Where each row is read, lanes from the beginning of the tape.
    pub from: Vec<u32>,
    /// Where each is added, lanes from the beginning of the result.
    pub to: Vec<u32>,
}

impl Linear {
    #[inline(always)]
    fn forward(&self, element: usize, tape: &mut [Lanes]) {
        let (before, out) = tape.split_at_mut(self.start);
        for part in &self.parts {
            part.weights.forward(element).multiply_add(before, &part.from, out, &part.to);
        }
    }

    #[inline(always)]
    fn backward(&self, element: usize, cotangent: &mut [Lanes]) {
        let (before, out) = cotangent.split_at_mut(self.start);
        for part in &self.parts {
            part.weights.transposed(element).multiply_add(out, &part.to, before, &part.from);
        }
    }

    fn keep(&mut self, needed: &mut [bool]) {
        for part in &mut self.parts {
            let rows = part.from.iter().zip(&part.to);
            let kept: Vec<(u32, u32)> =
                rows.map(|(f, t)| (*f, *t)).filter(|(_, to)| needed[self.start + *to as usize]).collect();
            kept.iter().for_each(|(from, _)| needed[*from as usize] = true);
            (part.from, part.to) = kept.into_iter().unzip();
        }
        self.parts.retain(|part| !part.from.is_empty());
    }
}

/// The rows of the tape that the energy and the features are made of, one after another.
#[derive(Clone, Debug, Default)]
pub(super) struct Gather {
    /// First lane and number of lanes of each row.
    pub rows: Vec<(usize, usize)>,
}

impl Gather {
    /// Lanes of all rows together.
    pub fn lanes(&self) -> usize {
        self.rows.iter().map(|(_, width)| width).sum()
    }

    #[inline(always)]
    pub fn forward(&self, tape: &[Lanes], out: &mut [Lanes]) {
        let mut position = 0;
        for (row, width) in &self.rows {
            out[position..position + width].copy_from_slice(&tape[*row..row + width]);
            position += width;
        }
    }

    /// Adds to the cotangents of the rows.
    #[inline(always)]
    pub fn backward(&self, out: &[Lanes], cotangent: &mut [Lanes]) {
        let mut position = 0;
        for (row, width) in &self.rows {
            for (sum, x) in cotangent[*row..row + width].iter_mut().zip(&out[position..]) {
                add_scaled(sum, 1.0, x);
            }
            position += width;
        }
    }
}
