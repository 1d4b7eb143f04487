//! The equivariant tensors of some atoms, and the operations that make one from others.
//!
//! All tensors stand behind one another on a tape, each \[component\]\[slot\]\[channel\], with a slot for each atom of a
//! batch: weights are read once for all of them. An operation reads rows that stand before its result. Cotangents stand
//! on a second tape of the same layout, which the operations walk backwards; its slots are \[cotangent\]\[atom\].
//! Places on a tape are those for one slot; with more slots a component begins at that many times the lane.

use super::equivariant_norm::EquivariantNorm;
use super::instructions::Instructions;
use super::matrix::Rows;
use super::product::{Combination, Product};
use super::vector::Vector;
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
    /// First lane of a component, for one slot.
    pub fn row(&self, component: usize) -> usize {
        self.start + component * self.width
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
                linear.parts.iter().flat_map(|part| &part.from).map(|row| *row as usize).collect()
            }
            Self::Product(product) => {
                let terms = product.outputs.iter().flat_map(|output| &output.terms);
                terms.flat_map(|term| [term.left as usize, term.right as usize]).collect()
            }
            Self::Combination(combination) => {
                let terms = combination.outputs.iter().flat_map(|(_, terms)| terms);
                terms.map(|(row, _)| *row as usize).collect()
            }
            Self::EquivariantNorm(norm) => (0..norm.from.components).map(|w| norm.from.row(w)).collect(),
        }
    }

    /// First lanes of the rows that it makes.
    pub fn writes(&self) -> Vec<usize> {
        match self {
            Self::Linear(linear) => linear
                .parts
                .iter()
                .flat_map(|part| &part.to)
                .map(|row| linear.start + *row as usize)
                .collect(),
            Self::Product(product) => product.outputs.iter().map(|output| output.row).collect(),
            Self::Combination(combination) => combination.outputs.iter().map(|(row, _)| *row).collect(),
            Self::EquivariantNorm(norm) => (0..norm.to.components).map(|w| norm.to.row(w)).collect(),
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
pub(super) struct Linear<V> {
    /// First lane of the result.
    pub start: usize,
    /// Rows that share weights.
    pub parts: Vec<LinearPart<V>>,
}

/// Rows of one or more tensors multiplied by the same weights.
#[derive(Clone, Debug)]
pub(super) struct LinearPart<V> {
    /// [n_in × n_out]
    pub weights: Weights<V>,
    /// Where each row is read, lanes from the beginning of the tape.
    pub from: Vec<u32>,
    /// Where each is added, lanes from the beginning of the result.
    pub to: Vec<u32>,
}

impl<V: Vector> Linear<V> {
    #[inline(always)]
    fn forward(&self, batch: &Batch, tape: &mut [V]) {
        let (before, out) = tape.split_at_mut(self.start * batch.atoms);
        for part in &self.parts {
            let (from, to) = part.rows(batch.atoms);
            part.weights.forward(batch.element).multiply_add(before, from, out, to, batch.instructions);
        }
    }

    #[inline(always)]
    fn backward<const N: usize>(&self, batch: &Batch, cotangent: &mut [V]) {
        let (before, out) = cotangent.split_at_mut(self.start * N * batch.atoms);
        for part in &self.parts {
            let (from, to) = part.rows(N * batch.atoms);
            part.weights.transposed(batch.element).multiply_add(out, to, before, from, batch.instructions);
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

impl<V: Vector> LinearPart<V> {
    #[inline(always)]
    fn rows(&self, slots: usize) -> (Rows<'_>, Rows<'_>) {
        let weights = self.weights.forward(0);
        let rows = |starts, stride| Rows { starts, slots, stride, shift: 0 };
        (rows(&self.from, weights.input_lanes()), rows(&self.to, weights.output_lanes()))
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

    /// Into `out`, a row of `stride` lanes for each atom.
    #[inline(always)]
    pub fn forward<V: Vector>(&self, atoms: usize, tape: &[V], out: &mut [V], stride: usize) {
        let mut position = 0;
        for (row, width) in &self.rows {
            for atom in 0..atoms {
                let (to, from) = (atom * stride + position, row * atoms + atom * width);
                out[to..to + width].copy_from_slice(&tape[from..from + width]);
            }
            position += width;
        }
    }

    /// Adds to the cotangents of the rows in the slots from `slot` of `slots`, from a row of `stride` lanes for each
    /// atom.
    #[inline(always)]
    pub fn backward<V: Vector>(
        &self,
        atoms: usize,
        (out, stride): (&[V], usize),
        cotangent: &mut [V],
        (slot, slots): (usize, usize),
    ) {
        let mut position = 0;
        for (row, width) in &self.rows {
            for atom in 0..atoms {
                let (from, to) = (atom * stride + position, row * slots + (slot + atom) * width);
                for (sum, x) in cotangent[to..to + width].iter_mut().zip(&out[from..from + width]) {
                    sum.add(x);
                }
            }
            position += width;
        }
    }
}

/// Ranges of the tape that hold anything, for one slot.
#[derive(Clone, Debug, Default)]
pub(super) struct Used(Vec<(usize, usize)>);

impl Used {
    /// From the first lanes and the numbers of lanes of rows, in ascending order.
    pub fn new(rows: impl Iterator<Item = (usize, usize)>) -> Self {
        let mut ranges: Vec<(usize, usize)> = Vec::new();
        for (row, width) in rows {
            match ranges.last_mut() {
                Some((_, end)) if *end == row => *end = row + width,
                _ => ranges.push((row, row + width)),
            }
        }
        Self(ranges)
    }

    /// Lanes of all ranges together.
    pub fn lanes(&self) -> usize {
        self.0.iter().map(|(start, end)| end - start).sum()
    }

    #[inline(always)]
    pub fn clear<V: Vector>(&self, slots: usize, tape: &mut [V]) {
        for (start, end) in &self.0 {
            tape[start * slots..end * slots].fill(V::ZERO);
        }
    }
}
