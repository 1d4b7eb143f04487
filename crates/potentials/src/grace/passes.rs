//! The passes over all atoms, chunk by chunk, by all threads.

use std::ops::Range;
use std::sync::{Mutex, MutexGuard, PoisonError};

use atoms::Vec3;

use super::batches::{Chunk, Placed, places_of};
use super::bonds::{BondWork, Bonds};
use super::evaluate::{Evaluator, add};
use super::instructions::{Instructions, Pass};
use super::layer::Layer;
use super::layer_work::{
    BackwardWork, Cotangents, Gradients, LayerWork, Trace, Traced, backward_bonds, backward_tape, forward,
    send,
};
use super::messages::Returns;
use super::network::Network;
use super::parts::{Layout, OfChunks, Parts, Shared};
use super::projection::{FeatureMap, Projected};
use super::readout::{Block, Readout, ReadoutWork};
use super::vector::Vector;

/// Work arrays of one thread.
#[derive(Clone, Debug)]
pub(super) struct Scratch<V> {
    /// For each layer.
    bonds: Vec<BondWork<V>>,
    readout: ReadoutWork<V>,
    backward: BackwardWork<V>,
    /// Of a batch whose trace is not kept.
    trace: Trace<V>,
}

impl<V: Vector> Scratch<V> {
    pub fn new(network: &Network<V>) -> Self {
        Self {
            bonds: network.layers.iter().map(BondWork::new).collect(),
            readout: ReadoutWork::default(),
            backward: BackwardWork::default(),
            trace: Trace::default(),
        }
    }
}

/// A thread that panicked has left nothing in its arrays that anybody reads.
fn of_thread<V>(scratch: &[Mutex<Scratch<V>>], thread: usize) -> MutexGuard<'_, Scratch<V>> {
    scratch[thread].lock().unwrap_or_else(PoisonError::into_inner)
}

impl<V: Vector> Evaluator<V> {
    /// Makes room for what the passes leave.
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

    /// Some chunks forwards through layer `k`, which forgets others, and what they tell the next one.
    pub(super) fn forward_layer(&mut self, k: usize, chunks: Range<usize>) {
        let Self { network, instructions, batches, scratch, .. } = self;
        let (here, after) = self.layers.split_at_mut(k + 1);
        let LayerWork { bonds, trace, messages: received, .. } = &mut here[k];
        let (bonds, received) = (&*bonds, &received[..]);
        let (chunks, places) = batches.among(chunks);
        let sent = match after.first_mut() {
            Some(next) => {
                let layout = Layout::Even(network.layers[k + 1].message.lanes());
                Parts::within(layout, &places, &mut next.messages)
            }
            None => Parts::new(Layout::Even(0), 0, &mut [][..]),
        };
        let work = (trace.hold(&network.layers[k], bonds, &places), sent);
        self.threads.each(chunks, work, &|chunk, (mut trace, mut sent), thread| {
            let work = &mut of_thread(scratch, thread).bonds[k];
            for batch in chunk.batches.clone() {
                let placed = batches.placed(batch, *instructions);
                let (layer, trace) = (&network.layers[k], &mut trace);
                instructions.run(Forward { layer, placed, bonds, received, trace, work });
                if let Some(next) = network.layers.get(k + 1) {
                    let sent = sent.of(&placed.places());
                    if let Some(tensor) = &next.message.from {
                        send(tensor, next.message.lanes(), &placed, trace, sent);
                    }
                }
            }
        });
    }

    /// Energies of some chunks from the bases of all layers.
    pub(super) fn read_out(&mut self, chunks: Range<usize>) {
        let Self { network, instructions, batches, layers, scratch, .. } = self;
        let per_atom = network.readout.blocks.len() * network.readout.density_lanes();
        let (chunks, places) = batches.among(chunks);
        let work = (
            Parts::within(Layout::Even(1), &places, &mut self.energies),
            Parts::within(Layout::Even(per_atom), &places, &mut self.density_cotangents),
        );
        self.threads.each(chunks, work, &|chunk, (mut energies, mut cotangents), thread| {
            let work = &mut of_thread(scratch, thread).readout;
            for batch in chunk.batches.clone() {
                let placed = batches.placed(batch, *instructions);
                let places = placed.places();
                let basis = |k: usize| layers[k].trace.bases(&network.layers[k]).of(&places);
                let (energies, cotangents) = (energies.of(&places), cotangents.of(&places));
                let readout = &network.readout;
                instructions.run(Energies { readout, placed, basis, energies, cotangents, work });
            }
        });
    }

    /// All atoms through the last layer, forwards and backwards; only energies and forces are kept.
    pub(super) fn pass_last_layer(&mut self) {
        let Self { network, instructions, batches, scratch, .. } = self;
        let last = self.layers.len() - 1;
        let (before, here) = self.layers.split_at_mut(last);
        let (layer, readout) = (&network.layers[last], &network.readout);
        let per_atom = readout.blocks.len() * readout.density_lanes();
        let LayerWork { bonds, messages: received, gradients, returns, rows, .. } = &mut here[0];
        let (bonds, received, rows) = (&*bonds, &received[..], &rows[..]);
        let work = (
            Parts::new(Layout::Even(1), 0, &mut self.energies[..]),
            Parts::new(Layout::Even(per_atom), 0, &mut self.density_cotangents[..]),
            gradients_of::<V, 1>(layer, bonds, &batches.chunks, gradients, returns),
        );
        self.threads.each(&batches.chunks, work, &|chunk, (mut energies, mut cotangents, to), thread| {
            let Scratch { bonds: work, readout: readout_work, backward, trace } =
                &mut *of_thread(scratch, thread);
            let (mut gradients, mut returns) = (to.bonds, to.returns.only());
            begin_returns::<V, 1>(layer, &mut returns);
            for batch in chunk.batches.clone() {
                let placed = batches.placed(batch, *instructions);
                let places = placed.places();
                let trace = &mut trace.hold(layer, bonds, &places);
                let work = &mut work[last];
                instructions.run(Forward { layer, placed, bonds, received, trace, work });
                let own = &*trace.bases.of(&places);
                let basis = |k: usize| match before.get(k) {
                    Some(work) => work.trace.bases(&network.layers[k]).of(&places),
                    None => own,
                };
                let (energies, cotangents) = (energies.of(&places), cotangents.of(&places));
                let energy_work = &mut *readout_work;
                instructions.run(Energies {
                    readout,
                    placed,
                    basis,
                    energies,
                    cotangents,
                    work: energy_work,
                });
                let densities = (&cotangents[last * readout.density_lanes()..], per_atom);
                let from = Cotangents { densities, basis: &[], returned: None };
                let (to, returns) = (&mut gradients, returns.as_deref_mut());
                let (block, work) = (&readout.blocks[last], (&mut *backward, work));
                let here = (bonds, received, rows);
                instructions.run(Backward::<V, 1> {
                    layer,
                    block,
                    placed,
                    here,
                    trace,
                    from,
                    to,
                    returns,
                    work,
                });
            }
        });
        self.finish_layer::<1>(last);
    }

    /// Some chunks, which the layer holds, backwards through layer `k`, with `N` cotangents: of the energy, and of the features.
    pub(super) fn backward_layer<const N: usize>(&mut self, k: usize, chunks: Range<usize>) {
        let Self { network, instructions, batches, scratch, density_cotangents, .. } = self;
        let (here, after) = self.layers.split_at_mut(k + 1);
        let (layer, block) = (&network.layers[k], &network.readout.blocks[k]);
        let LayerWork { bonds, trace, messages: received, gradients, returns, rows, .. } = &mut here[k];
        let (bonds, received, rows) = (&*bonds, &received[..], &rows[..]);
        let (chunks, _) = batches.among(chunks);
        let (traced, cotangents) = trace.held(layer, bonds);
        let work = (traced, gradients_of::<V, N>(layer, bonds, chunks, gradients, returns));
        self.threads.each(chunks, work, &|chunk, (mut trace, to), thread| {
            let Scratch { bonds: work, backward, .. } = &mut *of_thread(scratch, thread);
            let (mut gradients, mut returns) = (to.bonds, to.returns.only());
            begin_returns::<V, N>(layer, &mut returns);
            for batch in chunk.batches.clone() {
                let placed = batches.placed(batch, *instructions);
                let places = placed.places();
                let (lanes, stride) =
                    (block.lanes(), network.readout.blocks.len() * network.readout.density_lanes());
                let returned = after.first().map(|next| {
                    let message = &network.layers[k + 1].message;
                    let of_atom = message.passed() * network.layers[k + 1].density.width;
                    (message, next.message_cotangents.each_ref().map(|all| part(all, &places, of_atom)))
                });
                let from = Cotangents {
                    densities: (&density_cotangents[places.start * stride + k * lanes..], stride),
                    basis: cotangents.of(&places),
                    returned,
                };
                let (to, returns) = (&mut gradients, returns.as_deref_mut());
                let (here, trace) = ((bonds, received, rows), &mut trace);
                let work = (&mut *backward, &mut work[k]);
                instructions.run(Backward::<V, N> {
                    layer,
                    block,
                    placed,
                    here,
                    trace,
                    from,
                    to,
                    returns,
                    work,
                });
            }
        });
    }

    /// Sums what bonds and chunks have left of layer `k`.
    pub(super) fn finish_layer<const N: usize>(&mut self, k: usize) {
        let Self { network, batches, layers, .. } = self;
        let (layer, n) = (&network.layers[k], batches.order.len());
        let LayerWork { bonds, gradients, returns, message_cotangents, .. } = &mut layers[k];
        let [of_energy, of_features] = &mut self.forces;
        let even = Layout::Even(1);
        let forces = [Parts::new(even, 0, &mut of_energy[..]), Parts::new(even, 0, &mut of_features[..])];
        let work = (forces, OfChunks::within(&batches.chunks, &mut self.virials));
        self.threads.each(&batches.chunks, work, &|chunk, (mut forces, virials), _| {
            let Some(virials) = virials.only() else { return };
            for place in chunk.places.clone() {
                for k in 0..N {
                    let force = &mut forces[k].of(&(place..place + 1))[0];
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
            let sums = Parts::new(Layout::Even(lanes), 0, sums);
            let returns = &returns[..batches.chunks.len()];
            self.threads.each(&batches.chunks, sums, &|chunk, mut sums, _| {
                let sums = sums.of(&chunk.places);
                returns.iter().for_each(|returns| returns.add_to(k, &chunk.places, lanes, sums));
            });
        }
    }

    /// Features of some chunks from their bases.
    pub(super) fn project(&mut self, chunks: Range<usize>) {
        let Self { network, instructions, layers, projection: work, .. } = self;
        let Some(map) = &network.feature_map else { return };
        let (chunks, places) = self.batches.among(chunks);
        let work = work.parts(map, &places);
        self.threads.share(chunks, work, &|places, mut work| {
            let bases = |k: usize| layers[k].trace.bases(&network.layers[k]).of(places);
            let work = &mut work;
            instructions.run(Project { map, places, bases, work, instructions: *instructions });
        });
    }

    /// The cotangents of the bases of some chunks from those of their features, [places, D].
    pub(super) fn project_back(&mut self, chunks: Range<usize>, cotangent: &[f64]) {
        let Self { network, instructions, layers, projection: projected, .. } = self;
        let Some(map) = &network.feature_map else { return };
        let (chunks, all) = self.batches.among(chunks);
        let cotangent = Shared::new(map.projection.feature_dimension(), all.start, cotangent);
        self.threads.share(chunks, projected.parts(map, &all), &|places, mut work| {
            instructions.run(BeginProjectBack {
                map,
                places,
                cotangent: cotangent.of(places),
                work: &mut work,
            });
        });
        for (k, (work, layer)) in layers.iter_mut().zip(&network.layers).enumerate() {
            let (bases, out) = work.trace.basis_cotangents(layer, &all);
            let work = (projected.parts(map, &all), out);
            self.threads.share(chunks, work, &|places, (mut work, mut out)| {
                let (bases, out) = (bases.of(places), out.of(places));
                let (work, instructions) = (&mut work, *instructions);
                let pass = ProjectBack { map, layer: k, places, bases, out, work, instructions };
                instructions.run(pass);
            });
        }
    }
}

/// The numbers of some places, `of_one` for each.
fn part<'a, V>(numbers: &'a [V], places: &Range<usize>, of_one: usize) -> &'a [V] {
    numbers.get(places.start * of_one..places.end * of_one).unwrap_or_default()
}

/// Where `N` cotangents of a layer go to.
fn gradients_of<'a, V: Vector, const N: usize>(
    layer: &Layer<V>,
    bonds: &'a Bonds,
    chunks: &[Chunk],
    [of_energy, of_features]: &'a mut [Vec<Vec3>; 2],
    returns: &'a mut [Returns<V>],
) -> Gradients<'a, V> {
    let (ragged, places) = (Layout::Ragged(&bonds.offsets, 1), places_of(chunks));
    let of_features = match N {
        1 => Parts::new(Layout::Even(0), 0, &mut [][..]),
        _ => Parts::within(ragged, &places, of_features),
    };
    let returns = if layer.message.from.is_some() { returns } else { &mut [] };
    let bonds = [Parts::within(ragged, &places, of_energy), of_features];
    Gradients { bonds, returns: OfChunks::within(chunks, returns) }
}

fn begin_returns<V: Vector, const N: usize>(layer: &Layer<V>, returns: &mut Option<&mut Returns<V>>) {
    if let Some(returns) = returns {
        returns.begin(N, layer.message.passed() * layer.density.width);
    }
}

/// A batch forwards through one layer.
struct Forward<'a, 'b, V: Vector> {
    layer: &'a Layer<V>,
    placed: Placed,
    bonds: &'a Bonds,
    received: &'a [V],
    trace: &'a mut Traced<'b, V>,
    work: &'a mut BondWork<V>,
}

impl<V: Vector> Pass for Forward<'_, '_, V> {
    #[inline(always)]
    fn run(self, _: bool) {
        forward(self.layer, &self.placed, (self.bonds, self.received), self.trace, self.work);
    }
}

/// A batch from its bases to energies, and to ∂E/∂(W B).
struct Energies<'a, V, B> {
    readout: &'a Readout<V>,
    placed: Placed,
    basis: B,
    energies: &'a mut [f64],
    cotangents: &'a mut [V],
    work: &'a mut ReadoutWork<V>,
}

impl<'b, V: Vector, B: Fn(usize) -> &'b [V]> Pass for Energies<'_, V, B> {
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

/// A batch backwards through one layer, with `N` cotangents.
struct Backward<'a, 'b, 'c, V: Vector, const N: usize> {
    layer: &'a Layer<V>,
    block: &'a Block<V>,
    placed: Placed,
    here: (&'a Bonds, &'a [V], &'a [u32]),
    trace: &'a mut Traced<'b, V>,
    from: Cotangents<'a, V>,
    to: &'a mut [Parts<'c, Vec3>; 2],
    returns: Option<&'a mut Returns<V>>,
    work: (&'a mut BackwardWork<V>, &'a mut BondWork<V>),
}

impl<V: Vector, const N: usize> Pass for Backward<'_, '_, '_, V, N> {
    #[inline(always)]
    fn run(self, _: bool) {
        let Self { layer, block, placed, here, trace, from, to, returns, work } = self;
        let (backward, bonds) = work;
        backward_tape::<V, N>(layer, block, &placed, trace, &from, backward);
        backward_bonds::<V, N>(layer, &placed, here, trace, (to, returns), (backward, bonds));
    }
}

/// From the bases of some atoms to their features.
struct Project<'a, 'b, V, B> {
    map: &'a FeatureMap<V>,
    places: &'a Range<usize>,
    bases: B,
    work: &'a mut Projected<'b, V>,
    instructions: Instructions,
}

impl<'c, V: Vector, B: Fn(usize) -> &'c [V]> Pass for Project<'_, '_, V, B> {
    #[inline(always)]
    fn run(self, _: bool) {
        self.map.forward(self.places, self.bases, self.work, self.instructions);
    }
}

/// From the cotangents of features to those of their projections.
struct BeginProjectBack<'a, 'b, V> {
    map: &'a FeatureMap<V>,
    places: &'a Range<usize>,
    cotangent: &'a [f64],
    work: &'a mut Projected<'b, V>,
}

impl<V: Vector> Pass for BeginProjectBack<'_, '_, V> {
    #[inline(always)]
    fn run(self, _: bool) {
        self.map.begin_backward(self.places, self.cotangent, self.work);
    }
}

/// From there to those of the bases of one layer.
struct ProjectBack<'a, 'b, V> {
    map: &'a FeatureMap<V>,
    layer: usize,
    places: &'a Range<usize>,
    bases: &'a [V],
    out: &'a mut [V],
    work: &'a mut Projected<'b, V>,
    instructions: Instructions,
}

impl<V: Vector> Pass for ProjectBack<'_, '_, V> {
    #[inline(always)]
    fn run(self, _: bool) {
        let Self { map, layer, places, bases, out, work, instructions } = self;
        map.backward(layer, places, bases, out, work, instructions);
    }
}
