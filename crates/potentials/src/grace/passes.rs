//! The passes over all atoms, chunk by chunk, by all threads.

use std::ops::Range;
use std::sync::{Mutex, MutexGuard, PoisonError};

use atoms::Vec3;

use super::batches::Placed;
use super::bonds::{BondWork, Bonds};
use super::evaluate::{Grace, add};
use super::instructions::{Instructions, Pass};
use super::layer::Layer;
use super::layer_work::{
    BackwardWork, Cotangents, Gradients, LayerWork, Trace, Traced, backward_bonds, backward_tape, forward,
    send,
};
use super::matrix::{Lanes, ZERO};
use super::messages::Returns;
use super::model::GraceModel;
use super::parts::{Layout, OfChunks, Parts};
use super::projection::{Projected, Projection};
use super::readout::{Block, Readout, ReadoutWork};

/// Work arrays of one thread.
#[derive(Clone, Debug)]
pub(super) struct Scratch {
    /// For each layer.
    bonds: Vec<BondWork>,
    readout: ReadoutWork,
    backward: BackwardWork,
    /// Of a batch whose trace is not kept.
    trace: Trace,
}

impl Scratch {
    pub fn new(model: &GraceModel) -> Self {
        Self {
            bonds: model.layers.iter().map(BondWork::new).collect(),
            readout: ReadoutWork::default(),
            backward: BackwardWork::default(),
            trace: Trace::default(),
        }
    }
}

/// A thread that panicked has left nothing in its arrays that anybody reads.
fn of_thread(scratch: &[Mutex<Scratch>], thread: usize) -> MutexGuard<'_, Scratch> {
    scratch[thread].lock().unwrap_or_else(PoisonError::into_inner)
}

impl Grace {
    /// Makes room for what the passes leave.
    pub(super) fn begin_passes(&mut self) {
        let (n, readout) = (self.batches.order.len(), &self.model.readout);
        self.energies.resize(n, 0.0);
        self.density_cotangents.resize(n * readout.blocks.len() * readout.density_lanes(), ZERO);
        if let Some(projection) = &self.model.projection {
            self.projection.resize(projection, n);
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

    /// All atoms forwards through layer `k`, and what they tell the next one.
    pub(super) fn forward_layer(&mut self, k: usize) {
        let Self { model, instructions, batches, scratch, .. } = self;
        let (here, after) = self.layers.split_at_mut(k + 1);
        let LayerWork { bonds, trace, messages: received, .. } = &mut here[k];
        let (bonds, received) = (&*bonds, &received[..]);
        let sent = match after.first_mut() {
            Some(next) => {
                Parts::new(Layout::Even(model.layers[k + 1].message.lanes()), 0, &mut next.messages)
            }
            None => Parts::new(Layout::Even(0), 0, &mut [][..]),
        };
        let work = (trace.hold(&model.layers[k], bonds, &(0..batches.order.len())), sent);
        self.threads.each(&batches.chunks, work, &|chunk, (mut trace, mut sent), thread| {
            let work = &mut of_thread(scratch, thread).bonds[k];
            for batch in chunk.batches.clone() {
                let placed = batches.placed(batch, *instructions);
                let (layer, trace) = (&model.layers[k], &mut trace);
                instructions.run(Forward { layer, placed, bonds, received, trace, work });
                if let Some(next) = model.layers.get(k + 1) {
                    let sent = sent.of(&placed.places());
                    if let Some(tensor) = &next.message.from {
                        send(tensor, next.message.lanes(), &placed, trace, sent);
                    }
                }
            }
        });
    }

    /// Energies from the bases of all layers.
    pub(super) fn read_out(&mut self) {
        let Self { model, instructions, batches, layers, scratch, .. } = self;
        let per_atom = model.readout.blocks.len() * model.readout.density_lanes();
        let work = (
            Parts::new(Layout::Even(1), 0, &mut self.energies[..]),
            Parts::new(Layout::Even(per_atom), 0, &mut self.density_cotangents[..]),
        );
        self.threads.each(&batches.chunks, work, &|chunk, (mut energies, mut cotangents), thread| {
            let work = &mut of_thread(scratch, thread).readout;
            for batch in chunk.batches.clone() {
                let placed = batches.placed(batch, *instructions);
                let places = placed.places();
                let basis = |k: usize| basis(&model.layers[k], &layers[k], &places);
                let (energies, cotangents) = (energies.of(&places), cotangents.of(&places));
                let readout = &model.readout;
                instructions.run(Energies { readout, placed, basis, energies, cotangents, work });
            }
        });
    }

    /// All atoms through the last layer, forwards and backwards; only energies and forces are kept.
    pub(super) fn pass_last_layer(&mut self) {
        let Self { model, instructions, batches, scratch, .. } = self;
        let last = self.layers.len() - 1;
        let (before, here) = self.layers.split_at_mut(last);
        let (layer, readout) = (&model.layers[last], &model.readout);
        let per_atom = readout.blocks.len() * readout.density_lanes();
        let LayerWork { bonds, messages: received, gradients, returns, rows, .. } = &mut here[0];
        let (bonds, received, rows) = (&*bonds, &received[..], &rows[..]);
        let work = (
            Parts::new(Layout::Even(1), 0, &mut self.energies[..]),
            Parts::new(Layout::Even(per_atom), 0, &mut self.density_cotangents[..]),
            gradients_of::<1>(layer, bonds, gradients, returns),
        );
        self.threads.each(&batches.chunks, work, &|chunk, (mut energies, mut cotangents, to), thread| {
            let Scratch { bonds: work, readout: readout_work, backward, trace } =
                &mut *of_thread(scratch, thread);
            let (mut gradients, mut returns) = (to.bonds, to.returns.only());
            begin_returns::<1>(layer, &mut returns);
            for batch in chunk.batches.clone() {
                let placed = batches.placed(batch, *instructions);
                let places = placed.places();
                let trace = &mut trace.hold(layer, bonds, &places);
                let work = &mut work[last];
                instructions.run(Forward { layer, placed, bonds, received, trace, work });
                let own = &*trace.bases.of(&places);
                let basis =
                    |k: usize| if k < last { basis(&model.layers[k], &before[k], &places) } else { own };
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
                instructions.run(Backward::<1> {
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

    /// All atoms backwards through layer `k`, with `N` cotangents: of the energy, and of the features.
    pub(super) fn backward_layer<const N: usize>(&mut self, k: usize) {
        let Self { model, instructions, batches, scratch, density_cotangents, .. } = self;
        let (here, after) = self.layers.split_at_mut(k + 1);
        let (layer, block) = (&model.layers[k], &model.readout.blocks[k]);
        let LayerWork {
            bonds, trace, basis_cotangents, messages: received, gradients, returns, rows, ..
        } = &mut here[k];
        let (bonds, received, rows) = (&*bonds, &received[..], &rows[..]);
        let work = (
            trace.hold(layer, bonds, &(0..batches.order.len())),
            gradients_of::<N>(layer, bonds, gradients, returns),
        );
        self.threads.each(&batches.chunks, work, &|chunk, (mut trace, to), thread| {
            let Scratch { bonds: work, backward, .. } = &mut *of_thread(scratch, thread);
            let (mut gradients, mut returns) = (to.bonds, to.returns.only());
            begin_returns::<N>(layer, &mut returns);
            for batch in chunk.batches.clone() {
                let placed = batches.placed(batch, *instructions);
                let places = placed.places();
                let (lanes, stride) =
                    (block.lanes(), model.readout.blocks.len() * model.readout.density_lanes());
                let returned = after.first().map(|next| {
                    let message = &model.layers[k + 1].message;
                    let of_atom = message.passed() * model.layers[k + 1].density.width;
                    (message, next.message_cotangents.each_ref().map(|all| part(all, &places, of_atom)))
                });
                let from = Cotangents {
                    densities: (&density_cotangents[places.start * stride + k * lanes..], stride),
                    basis: part(basis_cotangents, &places, layer.basis.lanes()),
                    returned,
                };
                let (to, returns) = (&mut gradients, returns.as_deref_mut());
                let (here, trace) = ((bonds, received, rows), &mut trace);
                let work = (&mut *backward, &mut work[k]);
                instructions.run(Backward::<N> {
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
        self.finish_layer::<N>(k);
    }

    /// Sums what bonds and chunks have left of layer `k`.
    fn finish_layer<const N: usize>(&mut self, k: usize) {
        let Self { model, batches, layers, .. } = self;
        let (layer, n) = (&model.layers[k], batches.order.len());
        let LayerWork { bonds, gradients, returns, message_cotangents, .. } = &mut layers[k];
        let [of_energy, of_features] = &mut self.forces;
        let even = Layout::Even(1);
        let forces = [Parts::new(even, 0, &mut of_energy[..]), Parts::new(even, 0, &mut of_features[..])];
        let work = (forces, OfChunks::new(&mut self.virials));
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
            sums.resize(n * lanes, ZERO);
            let sums = Parts::new(Layout::Even(lanes), 0, sums);
            let returns = &returns[..batches.chunks.len()];
            self.threads.each(&batches.chunks, sums, &|chunk, mut sums, _| {
                let sums = sums.of(&chunk.places);
                returns.iter().for_each(|returns| returns.add_to(k, &chunk.places, lanes, sums));
            });
        }
    }

    /// Features from the bases.
    pub(super) fn project(&mut self) {
        let Self { model, instructions, layers, projection: work, .. } = self;
        let Some(projection) = &model.projection else { return };
        let work = work.parts(projection);
        self.threads.share(&self.batches.chunks, work, &|places, mut work| {
            let bases = |k: usize| basis(&model.layers[k], &layers[k], places);
            let work = &mut work;
            instructions.run(Project { projection, places, bases, work, instructions: *instructions });
        });
    }

    /// The cotangents of the bases from those of the features, [n, D] in the order of the structure.
    pub(super) fn project_back(&mut self, cotangent: &[f64]) {
        let Self { model, instructions, layers, batches, projection: projected, .. } = self;
        let Some(projection) = &model.projection else { return };
        let width = projection.feature_dimension();
        let of_place = |place: usize| &cotangent[batches.order[place] as usize * width..][..width];
        let work = projected.parts(projection);
        self.threads.share(&batches.chunks, work, &|places, mut work| {
            instructions.run(BeginProjectBack { projection, places, of_place, work: &mut work });
        });
        for (k, (work, layer)) in layers.iter_mut().zip(&model.layers).enumerate() {
            let (lanes, bases) = (layer.basis.lanes(), &work.trace.bases);
            work.basis_cotangents.resize(batches.order.len() * lanes, ZERO);
            let out = Parts::new(Layout::Even(lanes), 0, &mut work.basis_cotangents[..]);
            let work = (projected.parts(projection), out);
            self.threads.share(&batches.chunks, work, &|places, (mut work, mut out)| {
                let (bases, out) = (part(bases, places, lanes), out.of(places));
                let (work, instructions) = (&mut work, *instructions);
                let pass = ProjectBack { projection, layer: k, places, bases, out, work, instructions };
                instructions.run(pass);
            });
        }
    }
}

/// The numbers of some places, `of_one` for each.
fn part<'a>(numbers: &'a [Lanes], places: &Range<usize>, of_one: usize) -> &'a [Lanes] {
    numbers.get(places.start * of_one..places.end * of_one).unwrap_or_default()
}

fn basis<'a>(layer: &Layer, work: &'a LayerWork, places: &Range<usize>) -> &'a [Lanes] {
    part(&work.trace.bases, places, layer.basis.lanes())
}

/// Where `N` cotangents of a layer go to.
fn gradients_of<'a, const N: usize>(
    layer: &Layer,
    bonds: &'a Bonds,
    [of_energy, of_features]: &'a mut [Vec<Vec3>; 2],
    returns: &'a mut [Returns],
) -> Gradients<'a> {
    let ragged = Layout::Ragged(&bonds.offsets, 1);
    let of_features = match N {
        1 => Parts::new(Layout::Even(0), 0, &mut [][..]),
        _ => Parts::new(ragged, 0, &mut of_features[..]),
    };
    let returns = if layer.message.from.is_some() { returns } else { &mut [] };
    Gradients { bonds: [Parts::new(ragged, 0, of_energy), of_features], returns: OfChunks::new(returns) }
}

fn begin_returns<const N: usize>(layer: &Layer, returns: &mut Option<&mut Returns>) {
    if let Some(returns) = returns {
        returns.begin(N, layer.message.passed() * layer.density.width);
    }
}

/// A batch forwards through one layer.
struct Forward<'a, 'b> {
    layer: &'a Layer,
    placed: Placed,
    bonds: &'a Bonds,
    received: &'a [Lanes],
    trace: &'a mut Traced<'b>,
    work: &'a mut BondWork,
}

impl Pass for Forward<'_, '_> {
    #[inline(always)]
    fn run(self, _: bool) {
        forward(self.layer, &self.placed, (self.bonds, self.received), self.trace, self.work);
    }
}

/// A batch from its bases to energies, and to ∂E/∂(W B).
struct Energies<'a, B> {
    readout: &'a Readout,
    placed: Placed,
    basis: B,
    energies: &'a mut [f64],
    cotangents: &'a mut [Lanes],
    work: &'a mut ReadoutWork,
}

impl<'b, B: Fn(usize) -> &'b [Lanes]> Pass for Energies<'_, B> {
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
struct Backward<'a, 'b, 'c, const N: usize> {
    layer: &'a Layer,
    block: &'a Block,
    placed: Placed,
    here: (&'a Bonds, &'a [Lanes], &'a [u32]),
    trace: &'a mut Traced<'b>,
    from: Cotangents<'a>,
    to: &'a mut [Parts<'c, Vec3>; 2],
    returns: Option<&'a mut Returns>,
    work: (&'a mut BackwardWork, &'a mut BondWork),
}

impl<const N: usize> Pass for Backward<'_, '_, '_, N> {
    #[inline(always)]
    fn run(self, _: bool) {
        let Self { layer, block, placed, here, trace, from, to, returns, work } = self;
        let (backward, bonds) = work;
        backward_tape::<N>(layer, block, &placed, trace, &from, backward);
        backward_bonds::<N>(layer, &placed, here, trace, (to, returns), (backward, bonds));
    }
}

/// From the bases of some atoms to their features.
struct Project<'a, 'b, B> {
    projection: &'a Projection,
    places: &'a Range<usize>,
    bases: B,
    work: &'a mut Projected<'b>,
    instructions: Instructions,
}

impl<'c, B: Fn(usize) -> &'c [Lanes]> Pass for Project<'_, '_, B> {
    #[inline(always)]
    fn run(self, _: bool) {
        self.projection.forward(self.places, self.bases, self.work, self.instructions);
    }
}

/// From the cotangents of features to those of their projections.
struct BeginProjectBack<'a, 'b, C> {
    projection: &'a Projection,
    places: &'a Range<usize>,
    of_place: C,
    work: &'a mut Projected<'b>,
}

impl<'c, C: Fn(usize) -> &'c [f64]> Pass for BeginProjectBack<'_, '_, C> {
    #[inline(always)]
    fn run(self, _: bool) {
        self.projection.begin_backward(self.places, self.of_place, self.work);
    }
}

/// From there to those of the bases of one layer.
struct ProjectBack<'a, 'b> {
    projection: &'a Projection,
    layer: usize,
    places: &'a Range<usize>,
    bases: &'a [Lanes],
    out: &'a mut [Lanes],
    work: &'a mut Projected<'b>,
    instructions: Instructions,
}

impl Pass for ProjectBack<'_, '_> {
    #[inline(always)]
    fn run(self, _: bool) {
        let Self { projection, layer, places, bases, out, work, instructions } = self;
        projection.backward(layer, places, bases, out, work, instructions);
    }
}
