//! Forward and reverse pass of the last layer while its data are in the cache.

use std::ops::Range;

use super::batch_passes::{Backward, BeginProjectBack, Energies, Forward, Project, ProjectBack};
use super::batches::{Batches, Chunk, Placed};
use super::chunked_slices::{ChunkedSlice, PlaceLayout, SplitByChunk};
use super::evaluate::{Evaluator, GradeFunction};
use super::instructions::Instructions;
use super::layer_passes::{Cotangents, Gradients, LayerInput, LayerState};
use super::network::Network;
use super::projection::Projected;
use super::scratch::{Scratch, lock_scratch};
use super::sweeps::{begin_returns, gradients_of};
use super::vector::Vector;

/// Maximum number of layers before the last.
const MAX_EARLIER_LAYERS: usize = 2;

/// Data shared by all threads.
struct LastLayerPass<'a, V: Vector> {
    network: &'a Network<V>,
    instructions: Instructions,
    batches: &'a Batches,
    here: LayerInput<'a, V>,
    grade: Option<&'a GradeFunction<'a>>,
}

/// Output arrays, split by chunk.
struct Results<'a, V> {
    energies: ChunkedSlice<'a, f64>,
    /// ∂E/∂(W B)
    densities: ChunkedSlice<'a, V>,
    gradients: Gradients<'a, V>,
    /// `None` without grading.
    projected: Option<Projected<'a, V>>,
    /// The bases of the earlier layers. With two cotangents, the cotangents from the features overwrite them.
    bases: [ChunkedSlice<'a, V>; MAX_EARLIER_LAYERS],
}

impl<V: Send> SplitByChunk for Results<'_, V> {
    fn split(self, chunk: &Chunk) -> (Self, Self) {
        let (energies, densities) = (self.energies.split(chunk), self.densities.split(chunk));
        let (gradients, projected) = (self.gradients.split(chunk), self.projected.split(chunk));
        let bases = self.bases.split(chunk);
        (
            Self {
                energies: energies.0,
                densities: densities.0,
                gradients: gradients.0,
                projected: projected.0,
                bases: bases.0,
            },
            Self {
                energies: energies.1,
                densities: densities.1,
                gradients: gradients.1,
                projected: projected.1,
                bases: bases.1,
            },
        )
    }
}

impl<V: Vector> Evaluator<V> {
    /// The forward and reverse pass of all atoms through the last layer with `N` cotangents: of the energy, and
    /// of what `grade` computes from the features.
    pub(super) fn pass_last_layer<const N: usize>(&mut self, grade: Option<&GradeFunction>) {
        let Self { network, instructions, batches, scratch, projection, .. } = self;
        let last = self.layers.len() - 1;
        let (before, here) = self.layers.split_at_mut(last);
        let LayerState { bonds, messages, gradients, returns, rows, .. } = &mut here[0];
        let here = LayerInput::new(network, last, (bonds, messages, rows));
        let of_densities = network.readout.blocks.len() * network.readout.density_lanes();
        let map = network.feature_map.as_ref().filter(|_| grade.is_some());
        let mut results = Results {
            energies: ChunkedSlice::new(PlaceLayout::Even(1), 0, &mut self.energies[..]),
            densities: ChunkedSlice::new(
                PlaceLayout::Even(of_densities),
                0,
                &mut self.density_cotangents[..],
            ),
            gradients: gradients_of::<V, N>(here.layer, bonds, &batches.chunks, gradients, returns),
            projected: map.map(|map| projection.parts(map)),
            bases: [(); MAX_EARLIER_LAYERS].map(|()| ChunkedSlice::empty()),
        };
        for (bases, (work, layer)) in results.bases.iter_mut().zip(before.iter_mut().zip(&network.layers)) {
            *bases = work.trace.bases_mut(layer);
        }
        let pass = LastLayerPass { network, instructions: *instructions, batches, here, grade };
        self.threads.for_each_chunk(&batches.chunks, results, &|chunk, mut results, thread| {
            let scratch = &mut lock_scratch(scratch, thread);
            if let Some(returns) = results.gradients.returns.only() {
                begin_returns::<V, N>(here.layer, returns);
            }
            pass.run::<N>(chunk, &mut results, scratch);
        });
        if N == 2 {
            self.layers[..last].iter_mut().for_each(|work| work.trace.take_cotangents());
        }
        self.finish_layer::<N>(last);
    }
}

impl<V: Vector> LastLayerPass<'_, V> {
    /// With one cotangent, the reverse pass runs while the tape of the batch is in the cache; with two it waits
    /// for the features.
    fn run<const N: usize>(&self, chunk: &Chunk, results: &mut Results<V>, scratch: &mut Scratch<V>) {
        let LayerInput { layer, bonds, .. } = self.here;
        let batches = chunk.batches.clone().map(|batch| self.batches.placed(batch, self.instructions));
        scratch.trace.reserve_bases(layer, &chunk.places);
        if N == 1 {
            for placed in batches {
                if self.grade.is_none() {
                    scratch.trace.reserve_bases(layer, &placed.places());
                }
                scratch.trace.reserve(layer, bonds, &placed.places(), false);
                self.forward::<N>(placed, results, scratch);
                self.backward::<N>(placed, results, scratch);
            }
            self.grade::<N>(&chunk.places, results, scratch);
        } else {
            scratch.trace.reserve(layer, bonds, &chunk.places, true);
            batches.clone().for_each(|placed| self.forward::<N>(placed, results, scratch));
            self.grade::<N>(&chunk.places, results, scratch);
            batches.for_each(|placed| self.backward::<N>(placed, results, scratch));
        }
    }

    fn forward<const N: usize>(&self, placed: Placed, results: &mut Results<V>, scratch: &mut Scratch<V>) {
        let (last, places) = (self.network.layers.len() - 1, placed.places());
        let mut traced = scratch.trace.slices(self.here.layer, self.here.bonds);
        let (here, trace) = (self.here, &mut traced);
        let work = (&mut scratch.tape, &mut scratch.bonds[last]);
        self.instructions.run(Forward { here, placed, trace, work });
        if N == 2 {
            trace.keep(&places, &scratch.tape);
        }
        let own = &*traced.bases.slice(&places);
        let before = results.bases.each_mut().map(|bases| &*bases.slice(&places));
        let basis = |k: usize| if k == last { own } else { before[k] };
        let (energies, cotangents) = (results.energies.slice(&places), results.densities.slice(&places));
        let (readout, work) = (&self.network.readout, &mut scratch.readout);
        self.instructions.run(Energies { readout, placed, basis, energies, cotangents, work });
    }

    /// Computes features from bases and, with two cotangents, goes back to the cotangents of the bases.
    fn grade<const N: usize>(
        &self,
        places: &Range<usize>,
        results: &mut Results<V>,
        scratch: &mut Scratch<V>,
    ) {
        let (Some(map), Some(work)) = (&self.network.feature_map, &mut results.projected) else { return };
        let Some(grade) = self.grade else { return };
        let (instructions, last) = (self.instructions, self.network.layers.len() - 1);
        let mut traced = scratch.trace.slices(self.here.layer, self.here.bonds);
        let own = traced.bases.slice(places);
        let mut before = results.bases.each_mut().map(|bases| bases.slice(places));
        let bases = |k: usize| if k == last { &*own } else { &*before[k] };
        instructions.run(Project { map, places, bases, work, instructions });
        let (features, cotangent) = (work.features.slice(places), &mut scratch.feature_cotangent);
        cotangent.resize(if N == 2 { features.len() } else { 0 }, 0.0);
        grade(&self.batches.order[places.clone()], features, cotangent);
        if N == 1 {
            return;
        }
        instructions.run(BeginProjectBack { map, places, cotangent, work });
        let before = before.iter_mut().take(last).map(|bases| &mut **bases);
        for (layer, bases) in before.chain([own]).enumerate() {
            instructions.run(ProjectBack { map, layer, places, bases, work, instructions });
        }
    }

    fn backward<const N: usize>(&self, placed: Placed, results: &mut Results<V>, scratch: &mut Scratch<V>) {
        let (readout, places) = (&self.network.readout, placed.places());
        let (last, lanes) = (readout.blocks.len() - 1, readout.density_lanes());
        let mut traced = scratch.trace.slices(self.here.layer, self.here.bonds);
        let densities = (&results.densities.slice(&places)[last * lanes..], readout.blocks.len() * lanes);
        let from = Cotangents { densities, basis: traced.bases.slice(&places), returned: None };
        let tape = if N == 1 { &scratch.tape[..] } else { traced.tapes.slice(&places) };
        let (here, bonds, to) = (self.here, &mut traced.bonds, &mut results.gradients.bonds);
        let (returns, work) =
            (results.gradients.returns.only(), (&mut scratch.backward, &mut scratch.bonds[last]));
        self.instructions.run(Backward::<V, N> { here, placed, tape, bonds, from, to, returns, work });
    }
}
