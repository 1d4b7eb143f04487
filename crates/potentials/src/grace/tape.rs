//! The equivariant tensors of a batch of atoms, and the operations that compute one from others.
//!
//! All tensors follow one another on a tape, each \[component\]\[slot\]\[channel\], with a slot per atom of a
//! batch, so that weights are read once for all of them. An operation reads rows that precede its result.
//! Cotangents are on a second tape of the same layout, which the operations traverse in reverse; its slots are
//! \[cotangent\]\[atom\]. Lanes are given for one slot; with several slots a component starts at that multiple
//! of its lane.

use super::equivariant_norm::EquivariantNorm;
use super::instructions::Instructions;
use super::linear::Linear;
use super::product::{Combination, Product};
use super::vector::Vector;

/// The lanes of a tensor on the tape.
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
    /// First lane of a component, for one slot.
    pub fn row(&self, component: usize) -> usize {
        self.start + component * self.width
    }

    /// First lanes of all components, for one slot.
    pub fn rows(&self) -> impl Iterator<Item = usize> + use<> {
        let tensor = *self;
        (0..tensor.components).map(move |w| tensor.row(w))
    }

    /// One lane past the tensor, for one slot.
    pub fn end(&self) -> usize {
        self.start + self.components * self.width
    }
}

/// Atoms that are processed together.
#[derive(Clone, Copy, Debug)]
pub(super) struct AtomBatch {
    /// Their common element.
    pub element: usize,
    /// Their number.
    pub atoms: usize,
    pub instructions: Instructions,
}

/// The slot of an atom, or of one of its cotangents, on a tape.
#[derive(Clone, Copy, Debug)]
pub(super) struct TapeSlot {
    pub slot: usize,
    /// Number of slots.
    pub slots: usize,
}

impl TapeSlot {
    /// First lane of a component.
    #[inline(always)]
    pub fn row(self, tensor: &Tensor, component: usize) -> usize {
        tensor.row(component) * self.slots + self.slot * tensor.width
    }
}

/// An operation on the tape.
#[derive(Clone, Debug)]
pub(super) enum TapeOperation<V: Vector> {
    /// Mixes channels with weights.
    Linear(Linear<V>),
    /// Couples components, channel by channel.
    Product(Product<V>),
    /// Sums components with factors.
    Combination(Combination<V>),
    /// Divides components by their norm.
    EquivariantNorm(EquivariantNorm<V>),
}

impl<V: Vector> TapeOperation<V> {
    #[inline(always)]
    pub fn forward(&self, batch: &AtomBatch, tape: &mut [V]) {
        match self {
            Self::Linear(linear) => linear.forward(batch, tape),
            Self::Product(product) => product.forward(batch.atoms, tape),
            Self::Combination(combination) => combination.forward(batch.atoms, tape),
            Self::EquivariantNorm(norm) => norm.forward(batch.atoms, tape),
        }
    }

    /// Adds to `N` cotangents of the inputs.
    #[inline(always)]
    pub fn backward<const N: usize>(&self, batch: &AtomBatch, tape: &[V], cotangent: &mut [V]) {
        match self {
            Self::Linear(linear) => linear.backward::<N>(batch, cotangent),
            Self::Product(product) => product.backward::<N>(batch.atoms, tape, cotangent),
            Self::Combination(combination) => combination.backward(N * batch.atoms, cotangent),
            Self::EquivariantNorm(norm) => norm.backward::<N>(batch.atoms, tape, cotangent),
        }
    }

    /// The derivative of the result along that of the inputs, on a tape of the same layout.
    #[inline(always)]
    pub fn forward_derivative(&self, batch: &AtomBatch, tape: &[V], along: &mut [V]) {
        match self {
            Self::Linear(linear) => linear.forward(batch, along),
            Self::Product(product) => product.forward_derivative(batch.atoms, tape, along),
            Self::Combination(combination) => combination.forward(batch.atoms, along),
            Self::EquivariantNorm(_) => unreachable!("models of three layers are not trained"),
        }
    }

    /// Adds to two cotangents of the inputs: the first of their derivative along a direction, the second of
    /// their values.
    #[inline(always)]
    pub fn backward_derivative(&self, batch: &AtomBatch, tapes: [&[V]; 2], cotangent: &mut [V]) {
        self.backward::<2>(batch, tapes[0], cotangent);
        if let Self::Product(product) = self {
            product.backward_derivative(batch.atoms, tapes[1], cotangent);
        }
    }

    /// First lanes of the rows that it reads, for one slot.
    pub fn reads(&self) -> Vec<usize> {
        match self {
            Self::Linear(linear) => {
                linear.parts.iter().flat_map(|part| &part.tape[0]).map(|row| *row as usize).collect()
            }
            Self::Product(product) => {
                let terms = product.outputs.iter().flat_map(|output| &output.terms);
                terms.flat_map(|term| [term.left as usize, term.right as usize]).collect()
            }
            Self::Combination(combination) => {
                let terms = combination.outputs.iter().flat_map(|(_, terms)| terms);
                terms.map(|(row, _)| *row as usize).collect()
            }
            Self::EquivariantNorm(norm) => norm.from.rows().collect(),
        }
    }

    /// Those of them that the reverse pass reads again; in `training` it also computes derivatives with respect
    /// to weights.
    pub fn factors(&self, training: bool) -> Vec<usize> {
        match self {
            Self::Product(_) | Self::EquivariantNorm(_) => self.reads(),
            Self::Linear(_) if training => self.reads(),
            Self::Linear(_) | Self::Combination(_) => Vec::new(),
        }
    }

    /// First lanes of the rows that it produces.
    pub fn writes(&self) -> Vec<usize> {
        match self {
            Self::Linear(linear) => {
                linear.parts.iter().flat_map(|part| &part.tape[1]).map(|row| *row as usize).collect()
            }
            Self::Product(product) => product.outputs.iter().map(|output| output.row).collect(),
            Self::Combination(combination) => {
                combination.outputs.iter().map(|(row, _)| *row as usize).collect()
            }
            Self::EquivariantNorm(norm) => norm.to.rows().collect(),
        }
    }

    /// Drops every result that is not needed and marks the inputs of the others as needed. `needed` has a flag
    /// for each lane at which a row starts.
    pub fn keep(&mut self, needed: &mut [bool]) {
        match self {
            Self::Linear(linear) => linear.keep(needed),
            Self::Product(product) => product.keep(needed),
            Self::Combination(combination) => combination.keep(needed),
            Self::EquivariantNorm(norm) => norm.keep(needed),
        }
    }

    /// Replaces lanes of the graph with lanes of the tape and of the cotangents' tape.
    pub fn rename(&mut self, on_tape: impl Fn(u32) -> u32, of_cotangent: impl Fn(u32) -> u32) {
        match self {
            Self::Linear(linear) => linear.rename(on_tape, of_cotangent),
            Self::Product(product) => product.rename(on_tape, of_cotangent),
            Self::Combination(combination) => combination.rename(on_tape, of_cotangent),
            Self::EquivariantNorm(norm) => norm.rename(on_tape),
        }
    }
}
