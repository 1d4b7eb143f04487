//! The equivariant tensors of some atoms, and the operations that make one from others.
//!
//! All tensors stand behind one another on a tape, each \[component\]\[slot\]\[channel\], with a slot for each atom of a
//! batch: weights are read once for all of them. An operation reads rows that stand before its result. Cotangents stand
//! on a second tape of the same layout, which the operations walk backwards; its slots are \[cotangent\]\[atom\].
//! Places on a tape are those for one slot; with more slots a component begins at that many times the lane.

use super::equivariant_norm::EquivariantNorm;
use super::instructions::Instructions;
use super::linear::Linear;
use super::product::{Combination, Product};
use super::vector::Vector;

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

/// Atoms that pass a tape together.
#[derive(Clone, Copy, Debug)]
pub(super) struct Batch {
    /// The element of all of them.
    pub element: usize,
    /// How many they are.
    pub atoms: usize,
    pub instructions: Instructions,
}

/// The place of one atom, or of one of its cotangents, on a tape.
#[derive(Clone, Copy, Debug)]
pub(super) struct Slot {
    pub slot: usize,
    /// How many there are.
    pub slots: usize,
}

impl Slot {
    /// First lane of a component.
    #[inline(always)]
    pub fn row(self, tensor: &Tensor, component: usize) -> usize {
        tensor.row(component) * self.slots + self.slot * tensor.width
    }
}

/// One step along the tape.
#[derive(Clone, Debug)]
pub(super) enum Operation<V: Vector> {
    /// Channels mixed with weights.
    Linear(Linear<V>),
    /// Components coupled, channel by channel.
    Product(Product<V>),
    /// Components summed with factors.
    Combination(Combination<V>),
    /// Components divided by their norm.
    EquivariantNorm(EquivariantNorm<V>),
}

impl<V: Vector> Operation<V> {
    #[inline(always)]
    pub fn forward(&self, batch: &Batch, tape: &mut [V]) {
        match self {
            Self::Linear(linear) => linear.forward(batch, tape),
            Self::Product(product) => product.forward(batch.atoms, tape),
            Self::Combination(combination) => combination.forward(batch.atoms, tape),
            Self::EquivariantNorm(norm) => norm.forward(batch.atoms, tape),
        }
    }

    /// Adds to `N` cotangents of what it read.
    #[inline(always)]
    pub fn backward<const N: usize>(&self, batch: &Batch, tape: &[V], cotangent: &mut [V]) {
        match self {
            Self::Linear(linear) => linear.backward::<N>(batch, cotangent),
            Self::Product(product) => product.backward::<N>(batch.atoms, tape, cotangent),
            Self::Combination(combination) => combination.backward(N * batch.atoms, cotangent),
            Self::EquivariantNorm(norm) => norm.backward::<N>(batch.atoms, tape, cotangent),
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

    /// Those of them that the reverse sweep reads again.
    pub fn factors(&self) -> Vec<usize> {
        match self {
            Self::Product(_) | Self::EquivariantNorm(_) => self.reads(),
            Self::Linear(_) | Self::Combination(_) => Vec::new(),
        }
    }

    /// First lanes of the rows that it makes.
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

    /// Puts lanes of the tape and of the tape of cotangents in place of those of the graph.
    pub fn rename(&mut self, on_tape: impl Fn(u32) -> u32, of_cotangent: impl Fn(u32) -> u32) {
        match self {
            Self::Linear(linear) => linear.rename(on_tape, of_cotangent),
            Self::Product(product) => product.rename(on_tape, of_cotangent),
            Self::Combination(combination) => combination.rename(on_tape, of_cotangent),
            Self::EquivariantNorm(norm) => norm.rename(on_tape),
        }
    }
}
