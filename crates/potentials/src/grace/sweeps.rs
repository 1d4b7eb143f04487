//! Passes over all atoms, parallel over chunks.

use std::ops::Range;

use atoms::Vec3;

use super::batch_passes::{Backward, BeginProjectBack, Energies, Forward, Project, ProjectBack};
use super::batches::Chunk;
use super::bonds::GraceBonds;
use super::chunked_slices::{ChunkedSlice, PerChunk, PlaceLayout, SharedSlice};
use super::evaluate::{Evaluator, add};
use super::layer::Layer;
use super::layer_passes::{Cotangents, Gradients, LayerInput, LayerState, send};
use super::messages::ReturnedCotangents;
use super::scratch::{Scratch, lock_scratch};
use super::vector::Vector;

impl<V: Vector> Evaluator<V> {
    /// Sizes the output arrays of the passes.
    pub(super) fn begin_passes(&mut self) {
        let (n, readout) = (self.batches.order.len(), &self.network.readout);
        self.energies.resize(n, 0.0);
        self.density_cotangents.resize(n * readout.blocks.len() * readout.density_lanes(), V::ZERO);
        if let Some(map) = &self.network.feature_map {
            self.projection.resize(map, n);
        }
    }

    /// Sets forces and virials to zero.
    pub(super) fn begin_derivatives(&mut self) {
        for forces in &mut self.forces {
            forces.clear();
            forces.resize(self.batches.order.len(), [0.0; 3]);
        }
        self.virials.clear();
        self.virials.resize(self.batches.chunks.len(), Default::default());
    }

    /// The forward pass of all atoms through layer `k`, and their messages to the next one.
    pub(super) fn forward_layer(&mut self, k: usize) {
        let Self { network, instructions, batches, scratch, .. } = self;
        let (here, after) = self.layers.split_at_mut(k + 1);
        let LayerState { bonds, trace, messages, rows, .. } = &mut here[k];
        let here = LayerInput::new(network, k, (bonds, messages, rows));
        let sent = match after.first_mut() {
            Some(next) => {
                let layout = PlaceLayout::Even(network.layers[k + 1].message.lanes());
                ChunkedSlice::new(layout, 0, &mut next.messages[..])
            }
            None => ChunkedSlice::empty(),
        };
        let all = 0..batches.order.len();
        trace.reserve_bases(here.layer, &all);
        trace.reserve(here.layer, bonds, &all, true);
        let work = (trace.slices(here.layer, bonds), sent);
        self.threads.for_each_chunk(&batches.chunks, work, &|chunk, (mut trace, mut sent), thread| {
            let Scratch { tape, bonds, .. } = &mut *lock_scratch(scratch, thread);
            for batch in chunk.batches.clone() {
                let placed = batches.placed(batch, *instructions);
                let (places, trace) = (placed.places(), &mut trace);
                instructions.run(Forward { here, placed, trace, work: (tape, &mut bonds[k]) });
                trace.keep(&places, tape);
                if let Some(next) = network.layers.get(k + 1)
                    && let Some(tensor) = &next.message.from
                {
                    send(tensor, next.message.lanes(), &placed, tape, sent.slice(&places));
                }
            }
        });
    }

    /// Energies from the bases of all layers.
    pub(super) fn read_out(&mut self) {
        let Self { network, instructions, batches, layers, scratch, .. } = self;
        let per_atom = network.readout.blocks.len() * network.readout.density_lanes();
        let work = (
            ChunkedSlice::new(PlaceLayout::Even(1), 0, &mut self.energies[..]),
            ChunkedSlice::new(PlaceLayout::Even(per_atom), 0, &mut self.density_cotangents[..]),
        );
        self.threads.for_each_chunk(
            &batches.chunks,
            work,
            &|chunk, (mut energies, mut cotangents), thread| {
                let work = &mut lock_scratch(scratch, thread).readout;
                for batch in chunk.batches.clone() {
                    let placed = batches.placed(batch, *instructions);
                    let places = placed.places();
                    let basis = |k: usize| layers[k].trace.bases(&network.layers[k]).slice(&places);
                    let (energies, cotangents) = (energies.slice(&places), cotangents.slice(&places));
                    let readout = &network.readout;
                    instructions.run(Energies { readout, placed, basis, energies, cotangents, work });
                }
            },
        );
    }

    /// The reverse pass of all atoms through layer `k`, with `N` cotangents: of the energy and of the features.
    pub(super) fn backward_layer<const N: usize>(&mut self, k: usize) {
        let Self { network, instructions, batches, scratch, density_cotangents, .. } = self;
        let (here, after) = self.layers.split_at_mut(k + 1);
        let (lanes, n_layers) = (network.readout.density_lanes(), network.layers.len());
        let LayerState { bonds, trace, messages, gradients, returns, rows, .. } = &mut here[k];
        let here = LayerInput::new(network, k, (bonds, messages, rows));
        let (tapes, traced, cotangents) = trace.backward_slices(here.layer, bonds);
        let to = gradients_of::<V, N>(here.layer, bonds, &batches.chunks, gradients, returns);
        self.threads.for_each_chunk(&batches.chunks, ((tapes, traced), to), &|chunk, (trace, to), thread| {
            let (mut tapes, mut traced) = trace;
            let Scratch { bonds: work, backward, .. } = &mut *lock_scratch(scratch, thread);
            let Gradients { bonds: mut to, mut returns } = to;
            if let Some(returns) = returns.only() {
                begin_returns::<V, N>(here.layer, returns);
            }
            for batch in chunk.batches.clone() {
                let placed = batches.placed(batch, *instructions);
                let places = placed.places();
                let returned = after.first().map(|next| {
                    let message = &network.layers[k + 1].message;
                    let of_atom = message.passed() * network.layers[k + 1].density.width;
                    (message, next.message_cotangents.each_ref().map(|all| part(all, &places, of_atom)))
                });
                let stride = n_layers * lanes;
                let densities = (&density_cotangents[places.start * stride + k * lanes..], stride);
                let from = Cotangents { densities, basis: cotangents.slice(&places), returned };
                let (tape, bonds) = (&*tapes.slice(&places), &mut traced);
                let (to, returns, work) = (&mut to, returns.only(), (&mut *backward, &mut work[k]));
                instructions.run(Backward::<V, N> { here, placed, tape, bonds, from, to, returns, work });
            }
        });
    }

    /// Sums the contributions of bonds and chunks to layer `k`.
    pub(super) fn finish_layer<const N: usize>(&mut self, k: usize) {
        let Self { network, batches, layers, .. } = self;
        let (layer, n) = (&network.layers[k], batches.order.len());
        let LayerState { bonds, gradients, returns, message_cotangents, .. } = &mut layers[k];
        let [of_energy, of_features] = &mut self.forces;
        let even = PlaceLayout::Even(1);
        let forces = [
            ChunkedSlice::new(even, 0, &mut of_energy[..]),
            ChunkedSlice::new(even, 0, &mut of_features[..]),
        ];
        let work = (forces, PerChunk::within(&batches.chunks, &mut self.virials));
        self.threads.for_each_chunk(&batches.chunks, work, &|chunk, (mut forces, mut virials), _| {
            let Some(virials) = virials.only() else { return };
            for place in chunk.places.clone() {
                for k in 0..N {
                    let force = &mut forces[k].slice(&(place..place + 1))[0];
                    add(&mut virials[k], &bonds.gather(place, &gradients[k], force));
                }
            }
        });
        let lanes = layer.message.passed() * layer.density.width;
        if lanes == 0 {
            return;
        }
        for (k, sums) in message_cotangents.iter_mut().enumerate().take(N) {
            sums.clear();
            sums.resize(n * lanes, V::ZERO);
            let sums = ChunkedSlice::new(PlaceLayout::Even(lanes), 0, sums);
            let returns = &returns[..batches.chunks.len()];
            self.threads.for_each_chunk(&batches.chunks, sums, &|chunk, mut sums, _| {
                let sums = sums.slice(&chunk.places);
                returns.iter().for_each(|returns| returns.add_to(k, &chunk.places, lanes, sums));
            });
        }
    }

    /// Features from the bases of all layers.
    pub(super) fn project(&mut self) {
        let Self { network, instructions, batches, layers, projection: work, .. } = self;
        let Some(map) = &network.feature_map else { return };
        self.threads.for_each_share(&batches.chunks, work.parts(map), &|places, mut work| {
            let bases = |k: usize| layers[k].trace.bases(&network.layers[k]).slice(places);
            let work = &mut work;
            instructions.run(Project { map, places, bases, work, instructions: *instructions });
        });
    }

    /// The cotangents of the bases of all layers from those of the features, `[n, D]`.
    pub(super) fn project_back(&mut self, cotangent: &[f64]) {
        let Self { network, instructions, batches, layers, projection: projected, .. } = self;
        let Some(map) = &network.feature_map else { return };
        let cotangent = SharedSlice::new(map.projection.feature_dimension(), 0, cotangent);
        self.threads.for_each_share(&batches.chunks, projected.parts(map), &|places, mut work| {
            let (cotangent, work) = (cotangent.slice(places), &mut work);
            instructions.run(BeginProjectBack { map, places, cotangent, work });
        });
        for (k, (work, layer)) in layers.iter_mut().zip(&network.layers).enumerate() {
            let work = (projected.parts(map), work.trace.copy_of_bases(layer));
            self.threads.for_each_share(&batches.chunks, work, &|places, (mut work, mut bases)| {
                let (bases, work, instructions) = (bases.slice(places), &mut work, *instructions);
                instructions.run(ProjectBack { map, layer: k, places, bases, work, instructions });
            });
        }
    }
}

/// The elements of these places, `of_one` per place.
fn part<'a, V>(numbers: &'a [V], places: &Range<usize>, of_one: usize) -> &'a [V] {
    numbers.get(places.start * of_one..places.end * of_one).unwrap_or_default()
}

/// The output arrays for `N` cotangents of a layer.
pub(super) fn gradients_of<'a, V: Vector, const N: usize>(
    layer: &Layer<V>,
    bonds: &'a GraceBonds,
    chunks: &[Chunk],
    [of_energy, of_features]: &'a mut [Vec<Vec3>; 2],
    returns: &'a mut [ReturnedCotangents<V>],
) -> Gradients<'a, V> {
    let ragged = PlaceLayout::Ragged(&bonds.offsets, 1);
    let of_features =
        if N == 1 { ChunkedSlice::empty() } else { ChunkedSlice::new(ragged, 0, &mut of_features[..]) };
    let returns = if layer.message.from.is_some() { returns } else { &mut [] };
    let bonds = [ChunkedSlice::new(ragged, 0, &mut of_energy[..]), of_features];
    Gradients { bonds, returns: PerChunk::within(chunks, returns) }
}

/// Sizes the message cotangents of a chunk.
pub(super) fn begin_returns<V: Vector, const N: usize>(
    layer: &Layer<V>,
    returns: &mut ReturnedCotangents<V>,
) {
    returns.begin(N, layer.message.passed() * layer.density.width);
}
