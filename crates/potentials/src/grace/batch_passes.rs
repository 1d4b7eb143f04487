//! Passes over a batch or a range of atoms, compiled for the processor's vector instructions.

use std::ops::Range;

use atoms::Vec3;

use super::batches::Placed;
use super::bonds::BondWork;
use super::chunked_slices::ChunkedSlice;
use super::instructions::{Instructions, SimdPass};
use super::layer_passes::{
    BackwardWork, Cotangents, LayerInput, Traced, TracedBonds, backward_bonds, backward_tape, forward,
};
use super::messages::ReturnedCotangents;
use super::projection::{FeatureMap, Projected};
use super::readout::{Readout, ReadoutWork};
use super::vector::Vector;

/// The forward pass of a batch through one layer.
pub(super) struct Forward<'a, 'b, V: Vector> {
    pub here: LayerInput<'a, V>,
    pub placed: Placed,
    pub trace: &'a mut Traced<'b, V>,
    /// The tape to write, and scratch arrays.
    pub work: (&'a mut Vec<V>, &'a mut BondWork<V>),
}

impl<V: Vector> SimdPass for Forward<'_, '_, V> {
    #[inline(always)]
    fn run(self, _: bool) {
        forward(&self.here, &self.placed, self.trace, self.work);
    }
}

/// Energies of a batch and ∂E/∂(W B) from its bases.
pub(super) struct Energies<'a, V, B> {
    pub readout: &'a Readout<V>,
    pub placed: Placed,
    pub basis: B,
    pub energies: &'a mut [f64],
    pub cotangents: &'a mut [V],
    pub work: &'a mut ReadoutWork<V>,
}

impl<'b, V: Vector, B: Fn(usize) -> &'b [V]> SimdPass for Energies<'_, V, B> {
    #[inline(always)]
    fn run(self, _: bool) {
        let Self { readout, placed, basis, energies, cotangents, work } = self;
        readout.begin(placed.batch.atoms, work);
        for k in 0..readout.blocks.len() {
            let basis = basis(k);
            readout.add_densities(k, &placed.batch, (basis, basis.len() / placed.batch.atoms), work);
        }
        readout.evaluate(&placed.batch, energies, work);
        readout.density_cotangents(cotangents, work);
    }
}

/// The reverse pass of a batch through one layer, with `N` cotangents.
pub(super) struct Backward<'a, 'b, 'c, V: Vector, const N: usize> {
    pub here: LayerInput<'a, V>,
    pub placed: Placed,
    pub tape: &'a [V],
    pub bonds: &'a mut TracedBonds<'b, V>,
    pub from: Cotangents<'a, V>,
    pub to: &'a mut [ChunkedSlice<'c, Vec3>; 2],
    pub returns: Option<&'a mut ReturnedCotangents<V>>,
    pub work: (&'a mut BackwardWork<V>, &'a mut BondWork<V>),
}

impl<V: Vector, const N: usize> SimdPass for Backward<'_, '_, '_, V, N> {
    #[inline(always)]
    fn run(self, _: bool) {
        let Self { here, placed, tape, bonds, from, to, returns, work } = self;
        let (backward, of_bonds) = work;
        backward_tape::<V, N>(&here, &placed, tape, &from, backward);
        backward_bonds::<V, N>(&here, &placed, bonds, (to, returns), (backward, of_bonds));
    }
}

/// Features of a range of atoms from their bases.
pub(super) struct Project<'a, 'b, V, B> {
    pub map: &'a FeatureMap<V>,
    pub places: &'a Range<usize>,
    pub bases: B,
    pub work: &'a mut Projected<'b, V>,
    pub instructions: Instructions,
}

impl<'c, V: Vector, B: Fn(usize) -> &'c [V]> SimdPass for Project<'_, '_, V, B> {
    #[inline(always)]
    fn run(self, _: bool) {
        self.map.forward(self.places, self.bases, self.work, self.instructions);
    }
}

/// Cotangents of the projections from those of the features.
pub(super) struct BeginProjectBack<'a, 'b, V> {
    pub map: &'a FeatureMap<V>,
    pub places: &'a Range<usize>,
    pub cotangent: &'a [f64],
    pub work: &'a mut Projected<'b, V>,
}

impl<V: Vector> SimdPass for BeginProjectBack<'_, '_, V> {
    #[inline(always)]
    fn run(self, _: bool) {
        self.map.begin_backward(self.places, self.cotangent, self.work);
    }
}

/// Cotangents of one layer's bases from those of the projections; overwrites the bases.
pub(super) struct ProjectBack<'a, 'b, V> {
    pub map: &'a FeatureMap<V>,
    pub layer: usize,
    pub places: &'a Range<usize>,
    pub bases: &'a mut [V],
    pub work: &'a mut Projected<'b, V>,
    pub instructions: Instructions,
}

impl<V: Vector> SimdPass for ProjectBack<'_, '_, V> {
    #[inline(always)]
    fn run(self, _: bool) {
        let Self { map, layer, places, bases, work, instructions } = self;
        map.backward(layer, places, bases, work, instructions);
    }
}
