//! Forward and reverse pass of one layer, batch by batch.

use std::ops::Range;

use atoms::Vec3;

use super::batches::{Batches, Chunk, Placed};
use super::bonds::{BondWork, GraceBonds, OwnBonds, accumulate, reverse};
use super::chunked_slices::{ChunkedSlice, PerChunk, PlaceLayout, SharedSlice, SplitByChunk};
use super::layer::{Layer, LayerMessage};
use super::matrix::StridedRows;
use super::messages::{ReturnedCotangents, accumulate_messages, reverse_messages};
use super::network::Network;
use super::readout::ReadoutBlock;
use super::tape::{TapeSlot, Tensor};
use super::vector::Vector;

/// Arrays of one layer for all atoms, in evaluation order.
#[derive(Clone, Debug, Default)]
pub(super) struct LayerState<V> {
    pub bonds: GraceBonds,
    pub trace: Trace<V>,
    /// m, `[n, lanes of a message]`; empty in the first layer.
    pub messages: Vec<V>,
    /// Cotangents of the messages from the energy and from the features, `[n, lanes]`.
    pub message_cotangents: [Vec<V>; 2],
    /// The contribution of each chunk to them.
    pub returns: Vec<ReturnedCotangents<V>>,
    /// The row of each bond's neighbour in them.
    pub rows: Vec<u32>,
    /// ∂/∂d of the energy and of H for each bond.
    pub gradients: [Vec<Vec3>; 2],
}

impl<V: Vector> LayerState<V> {
    /// Sizes the arrays for the current bonds.
    pub fn begin(&mut self, layer: &Layer<V>, batches: &Batches, elements: &[usize], row_of: &mut Vec<u32>) {
        self.gradients.iter_mut().for_each(|gradients| gradients.resize(self.bonds.bonds.len(), [0.0; 3]));
        if layer.message.from.is_none() {
            return;
        }
        self.messages.resize(elements.len() * layer.message.lanes(), V::ZERO);
        for (atom, message) in batches.order.iter().zip(self.messages.chunks_exact_mut(layer.message.lanes()))
        {
            message.copy_from_slice(&layer.message.constants[elements[*atom as usize]]);
        }
        row_of.resize(elements.len(), 0);
        self.rows.resize(self.bonds.bonds.len(), 0);
        if self.returns.len() < batches.chunks.len() {
            self.returns.resize_with(batches.chunks.len(), ReturnedCotangents::default);
        }
        for (chunk, returns) in batches.chunks.iter().zip(&mut self.returns) {
            returns.find(&self.bonds, chunk, row_of, &mut self.rows);
        }
    }
}

/// What the forward pass leaves for the reverse pass of some atoms.
#[derive(Clone, Debug, Default)]
pub(super) struct Trace<V> {
    /// First place.
    first: usize,
    /// First place whose basis is kept; there may be more of these.
    first_basis: usize,
    /// The part of each batch's tape that the reverse pass reads, `[places, kept lanes]`.
    tapes: Vec<V>,
    /// The basis B of this layer, `[places, lanes]`.
    bases: Vec<V>,
    /// Its cotangents from the features, `[places, lanes]`.
    basis_cotangents: Vec<V>,
    /// Radial values of bonds and their derivatives, in blocks.
    values: Vec<V>,
    derivatives: Vec<V>,
}

/// Slices of the trace that can be split.
pub(super) struct Traced<'a, V> {
    pub tapes: ChunkedSlice<'a, V>,
    pub bases: ChunkedSlice<'a, V>,
    pub bonds: TracedBonds<'a, V>,
}

impl<V: Vector> Traced<'_, V> {
    /// Stores the part of a batch's tape that the reverse pass needs.
    pub fn keep(&mut self, places: &Range<usize>, tape: &[V]) {
        let kept = self.tapes.slice(places);
        kept.copy_from_slice(&tape[..kept.len()]);
    }
}

/// The bond data of the trace.
pub(super) struct TracedBonds<'a, V> {
    values: ChunkedSlice<'a, V>,
    derivatives: ChunkedSlice<'a, V>,
}

impl<V> TracedBonds<'_, V> {
    /// The bonds of the atom at a place.
    #[inline(always)]
    fn at<'a>(&'a mut self, place: usize, bonds: &'a GraceBonds) -> OwnBonds<'a, V> {
        let places = place..place + 1;
        let (values, derivatives) = (self.values.slice(&places), self.derivatives.slice(&places));
        OwnBonds { bonds: bonds.at(place), values, derivatives }
    }
}

impl<V: Vector> Trace<V> {
    /// Allocates the bases of these places and discards others.
    pub fn reserve_bases(&mut self, layer: &Layer<V>, places: &Range<usize>) {
        grow(&mut self.bases, places.len() * layer.steps.basis_lanes);
        self.first_basis = places.start;
    }

    /// Allocates the bond data and, on request, the tapes of these places.
    pub fn reserve(&mut self, layer: &Layer<V>, bonds: &GraceBonds, places: &Range<usize>, keep_tapes: bool) {
        let blocks = bonds.block_offsets[places.end] - bonds.block_offsets[places.start];
        let of_block = V::LANES * layer.radial.output_lanes();
        grow(&mut self.tapes, if keep_tapes { places.len() * layer.steps.kept_lanes } else { 0 });
        grow(&mut self.values, blocks * of_block);
        grow(&mut self.derivatives, blocks * of_block);
        self.first = places.start;
    }

    /// The slices of all data.
    pub fn slices<'a>(&'a mut self, layer: &Layer<V>, bonds: &'a GraceBonds) -> Traced<'a, V> {
        self.parts(layer, bonds).0
    }

    /// The slices that a reverse pass needs, with the cotangents of the basis.
    pub fn backward_slices<'a>(
        &'a mut self,
        layer: &Layer<V>,
        bonds: &'a GraceBonds,
    ) -> (ChunkedSlice<'a, V>, TracedBonds<'a, V>, SharedSlice<'a, V>) {
        let (Traced { tapes, bonds, .. }, cotangents) = self.parts(layer, bonds);
        (tapes, bonds, cotangents)
    }

    fn parts<'a>(
        &'a mut self,
        layer: &Layer<V>,
        bonds: &'a GraceBonds,
    ) -> (Traced<'a, V>, SharedSlice<'a, V>) {
        let (steps, of_block) = (&layer.steps, V::LANES * layer.radial.output_lanes());
        let of_bonds = PlaceLayout::Ragged(&bonds.block_offsets, of_block);
        let traced = Traced {
            tapes: ChunkedSlice::new(PlaceLayout::Even(steps.kept_lanes), self.first, &mut self.tapes),
            bases: ChunkedSlice::new(PlaceLayout::Even(steps.basis_lanes), self.first_basis, &mut self.bases),
            bonds: TracedBonds {
                values: ChunkedSlice::new(of_bonds, self.first, &mut self.values),
                derivatives: ChunkedSlice::new(of_bonds, self.first, &mut self.derivatives),
            },
        };
        (traced, SharedSlice::new(steps.basis_lanes, self.first_basis, &self.basis_cotangents))
    }

    /// B.
    pub fn bases(&self, layer: &Layer<V>) -> SharedSlice<'_, V> {
        SharedSlice::new(layer.steps.basis_lanes, self.first_basis, &self.bases)
    }

    /// B, to be overwritten by its cotangents.
    pub fn bases_mut(&mut self, layer: &Layer<V>) -> ChunkedSlice<'_, V> {
        ChunkedSlice::new(PlaceLayout::Even(layer.steps.basis_lanes), self.first_basis, &mut self.bases)
    }

    /// A copy of B, to be overwritten by its cotangents.
    pub fn copy_of_bases(&mut self, layer: &Layer<V>) -> ChunkedSlice<'_, V> {
        self.basis_cotangents.clone_from(&self.bases);
        ChunkedSlice::new(
            PlaceLayout::Even(layer.steps.basis_lanes),
            self.first_basis,
            &mut self.basis_cotangents,
        )
    }

    /// Replaces B with its cotangents.
    pub fn take_cotangents(&mut self) {
        std::mem::swap(&mut self.bases, &mut self.basis_cotangents);
    }
}

impl<V: Send> SplitByChunk for Traced<'_, V> {
    fn split(self, chunk: &Chunk) -> (Self, Self) {
        let (tapes, bases) = (self.tapes.split(chunk), self.bases.split(chunk));
        let bonds = self.bonds.split(chunk);
        (
            Self { tapes: tapes.0, bases: bases.0, bonds: bonds.0 },
            Self { tapes: tapes.1, bases: bases.1, bonds: bonds.1 },
        )
    }
}

impl<V: Send> SplitByChunk for TracedBonds<'_, V> {
    fn split(self, chunk: &Chunk) -> (Self, Self) {
        let (values, derivatives) = (self.values.split(chunk), self.derivatives.split(chunk));
        (
            Self { values: values.0, derivatives: derivatives.0 },
            Self { values: values.1, derivatives: derivatives.1 },
        )
    }
}

/// Grows an array to at least this length.
pub(super) fn grow<V: Vector>(lanes: &mut Vec<V>, length: usize) {
    if lanes.len() < length {
        lanes.resize(length, V::ZERO);
    }
}

/// A layer with the data of all atoms before its pass.
#[derive(Clone, Copy)]
pub(super) struct LayerInput<'a, V: Vector> {
    pub layer: &'a Layer<V>,
    /// The layer's part of the readout.
    pub block: &'a ReadoutBlock<V>,
    pub bonds: &'a GraceBonds,
    /// The messages of all atoms.
    pub received: &'a [V],
    /// As [`LayerState::rows`].
    pub rows: &'a [u32],
}

impl<'a, V: Vector> LayerInput<'a, V> {
    /// Layer `k` with the bonds, messages and rows of its arrays.
    pub fn new(
        network: &'a Network<V>,
        k: usize,
        (bonds, received, rows): (&'a GraceBonds, &'a [V], &'a [u32]),
    ) -> Self {
        Self { layer: &network.layers[k], block: &network.readout.blocks[k], bonds, received, rows }
    }
}

/// Computes the tape of a batch and its part of the basis.
#[inline(always)]
pub(super) fn forward<V: Vector>(
    &LayerInput { layer, bonds, received, .. }: &LayerInput<V>,
    placed: &Placed,
    trace: &mut Traced<V>,
    (tape, work): (&mut Vec<V>, &mut BondWork<V>),
) {
    let (batch, places, steps) = (&placed.batch, placed.places(), &layer.steps);
    grow(tape, batch.atoms * steps.tape_lanes);
    tape[..batch.atoms * steps.fixed_lanes].fill(V::ZERO);
    for (slot, place) in places.clone().enumerate() {
        let density = (&mut tape[..], TapeSlot { slot, slots: batch.atoms });
        let own = trace.bonds.at(place, bonds);
        match layer.message.from {
            None => accumulate(layer, batch.element, own, density, work),
            Some(_) => accumulate_messages(layer, batch.element, own, received, density, work),
        }
    }
    steps.forward(batch, tape, trace.bases.slice(&places));
}

/// Adds the results of a batch to the messages of its atoms, which start as constants.
#[inline(always)]
pub(super) fn send<V: Vector>(
    tensor: &Tensor,
    of_message: usize,
    placed: &Placed,
    tape: &[V],
    messages: &mut [V],
) {
    for (slot, message) in messages.chunks_exact_mut(of_message).enumerate() {
        let slot = TapeSlot { slot, slots: placed.batch.atoms };
        for (q, row) in message.chunks_exact_mut(tensor.width).take(tensor.components).enumerate() {
            for (m, x) in row.iter_mut().zip(&tape[slot.row(tensor, q)..]) {
                m.add(x);
            }
        }
    }
}

/// Inputs of a batch's reverse pass.
pub(super) struct Cotangents<'a, V> {
    /// ∂E/∂(W B) of the layer's block, one row of `stride` lanes per atom.
    pub densities: (&'a [V], usize),
    /// Cotangents of the basis from the features, one row per atom.
    pub basis: &'a [V],
    /// The message of the next layer and its cotangents, one row per atom.
    pub returned: Option<(&'a LayerMessage<V>, [&'a [V]; 2])>,
}

/// Outputs of a reverse pass.
pub(super) struct Gradients<'a, V> {
    /// Gradients of the energy and of H for each bond.
    pub bonds: [ChunkedSlice<'a, Vec3>; 2],
    /// Message cotangents per chunk.
    pub returns: PerChunk<'a, ReturnedCotangents<V>>,
}

impl<V: Send> SplitByChunk for Gradients<'_, V> {
    fn split(self, chunk: &Chunk) -> (Self, Self) {
        let (bonds, returns) = (self.bonds.split(chunk), self.returns.split(chunk));
        (Self { bonds: bonds.0, returns: returns.0 }, Self { bonds: bonds.1, returns: returns.1 })
    }
}

/// Scratch arrays of one thread for a batch in a layer.
#[derive(Clone, Debug, Default)]
pub(super) struct BackwardWork<V> {
    /// Cotangents of the basis from the energy.
    basis: Vec<V>,
    /// Cotangents of the tape from the energy and from the features.
    tape: Vec<V>,
}

/// The reverse pass of a batch along its tape.
#[inline(always)]
pub(super) fn backward_tape<V: Vector, const N: usize>(
    &LayerInput { layer, block, .. }: &LayerInput<V>,
    placed: &Placed,
    tape: &[V],
    from: &Cotangents<V>,
    work: &mut BackwardWork<V>,
) {
    let (batch, steps) = (&placed.batch, &layer.steps);
    let (atoms, slots) = (batch.atoms, N * batch.atoms);
    grow(&mut work.tape, slots * steps.cotangent_lanes);
    let cotangent = &mut work.tape[..];
    cotangent[..slots * steps.fixed_lanes].fill(V::ZERO);
    if let Some((LayerMessage { from: Some(tensor), .. }, returned)) = &from.returned {
        for (k, rows) in returned.iter().enumerate().take(N) {
            add_returned(tensor, rows, cotangent, (k * atoms, slots));
        }
    }
    energy_basis_cotangent(block, placed, from.densities, steps.basis_lanes, &mut work.basis);
    let bases = std::array::from_fn(|k| if k == 0 { &work.basis[..] } else { from.basis });
    steps.backward::<N>(batch, tape, cotangent, bases);
}

/// ∂E/∂B of a batch.
#[inline(always)]
fn energy_basis_cotangent<V: Vector>(
    block: &ReadoutBlock<V>,
    placed: &Placed,
    (densities, stride): (&[V], usize),
    lanes: usize,
    out: &mut Vec<V>,
) {
    let atoms = placed.batch.atoms;
    out.clear();
    out.resize(atoms * lanes, V::ZERO);
    let (from, to) = (StridedRows::of_atoms(atoms, stride), StridedRows::of_atoms(atoms, lanes));
    let weights = block.weights.transposed(placed.batch.element);
    weights.multiply_add((densities, &mut out[..]), from, to, placed.batch.instructions);
}

/// Adds the cotangents of messages, one row per atom, to the tape's cotangents in the slots from `first` of
/// `slots`.
#[inline(always)]
pub(super) fn add_returned<V: Vector>(
    tensor: &Tensor,
    rows: &[V],
    tape: &mut [V],
    (first, slots): (usize, usize),
) {
    for (atom, row) in rows.chunks_exact(tensor.components * tensor.width).enumerate() {
        let slot = TapeSlot { slot: first + atom, slots };
        for (q, row) in row.chunks_exact(tensor.width).enumerate() {
            for (x, c) in tape[slot.row(tensor, q)..].iter_mut().zip(row) {
                x.add(c);
            }
        }
    }
}

/// The reverse pass of a batch from the cotangents of its tape along its bonds.
#[inline(always)]
pub(super) fn backward_bonds<V: Vector, const N: usize>(
    &LayerInput { layer, bonds, received, rows, .. }: &LayerInput<V>,
    placed: &Placed,
    traced: &mut TracedBonds<V>,
    (to, mut returns): (&mut [ChunkedSlice<Vec3>; 2], Option<&mut ReturnedCotangents<V>>),
    (tape, work): (&BackwardWork<V>, &mut BondWork<V>),
) {
    let atoms = placed.batch.atoms;
    for (slot, place) in placed.places().enumerate() {
        let slots = std::array::from_fn(|k| TapeSlot { slot: k * atoms + slot, slots: N * atoms });
        let cotangent = (&tape.tape[..], slots);
        let own = traced.at(place, bonds);
        let mut both = to.each_mut().map(|part| Some(part.slice(&(place..place + 1))));
        let gradients: [&mut [Vec3]; N] = std::array::from_fn(|k| both[k].take().unwrap_or_default());
        match &mut returns {
            None => reverse(layer, own, cotangent, work, gradients),
            Some(returns) => {
                let rows = &rows[bonds.offsets[place]..bonds.offsets[place + 1]];
                let returns = (rows, &mut **returns);
                reverse_messages(layer, own, received, cotangent, work, gradients, returns);
            }
        }
    }
}
