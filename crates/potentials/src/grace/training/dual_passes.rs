//! The passes of batches of atoms through the layers, with the derivative along a direction beside each value.

use std::sync::Arc;

use super::super::batches::{Batches, Placed};
use super::super::instructions::{Instructions, SimdPass};
use super::super::layer_passes::{add_returned, grow, send};
use super::super::matrix::StridedRows;
use super::super::network::Network;
use super::super::readout::ReadoutBlock;
use super::super::tape::{TapeSlot, Tensor};
use super::super::vector::{Double, Vector};
use super::dual_bonds::{BlockWork, accumulate, reverse};
use super::dual_readout::{DualReadoutWork, densities, multiply, read_out};
use super::moving_bonds::MovingStructure;
use super::sums::{LayerSums, WeightSums};

/// The state of the passes through one structure.
#[derive(Debug)]
pub(super) struct DualPasses {
    pub network: Arc<Network<Double>>,
    /// To be updated before the passes.
    pub bonds: MovingStructure,
    layers: Vec<LayerArrays>,
    work: BatchWork,
}

/// Values and derivatives of all atoms in a layer.
#[derive(Clone, Debug, Default)]
struct LayerArrays {
    /// m, `[place, lanes]`
    messages: [Vec<Double>; 2],
    /// Cotangents of the derivatives and of the values of the components of m that depend on the environment.
    returned: [Vec<Double>; 2],
    /// W B, `[place, lanes]`
    densities: [Vec<Double>; 2],
    /// Cotangents of its derivatives and values.
    of_densities: [Vec<Double>; 2],
}

/// Scratch arrays for one batch.
#[derive(Clone, Debug, Default)]
struct BatchWork {
    tapes: [Vec<Double>; 2],
    bases: [Vec<Double>; 2],
    of_bases: [Vec<Double>; 2],
    cotangent: Vec<Double>,
    block: BlockWork,
    readout: DualReadoutWork,
}

impl DualPasses {
    pub fn new(network: Arc<Network<Double>>) -> Self {
        let layers = vec![LayerArrays::default(); network.layers.len()];
        Self { network, bonds: MovingStructure::default(), layers, work: BatchWork::default() }
    }

    /// Sizes the arrays of all layers; messages start as constants.
    pub fn begin(&mut self, elements: &[usize], batches: &Batches) {
        let (n, lanes) = (elements.len(), self.network.readout.density_lanes());
        for (layer, arrays) in self.network.layers.iter().zip(&mut self.layers) {
            let of_message = layer.message.lanes();
            let [messages, along] = &mut arrays.messages;
            messages.resize(n * of_message, Double::ZERO);
            along.clear();
            along.resize(messages.len(), Double::ZERO);
            for (atom, row) in batches.order.iter().zip(messages.chunks_exact_mut(of_message)) {
                row.copy_from_slice(&layer.message.constants[elements[*atom as usize]]);
            }
            let passed = layer.message.passed() * layer.density.width;
            for returned in &mut arrays.returned {
                returned.clear();
                returned.resize(n * passed, Double::ZERO);
            }
            for rows in arrays.densities.iter_mut().chain(&mut arrays.of_densities) {
                rows.resize(n * lanes, Double::ZERO);
            }
        }
    }

    /// Computes tapes, bases and densities of a batch in layer `k`.
    pub fn forward(&mut self, k: usize, placed: Placed) {
        Instructions::best().run(ForwardBatch { passes: self, k, placed });
    }

    /// Adds the results of a batch, whose tapes are present, to its messages to the layer after `k`.
    pub fn send(&mut self, k: usize, placed: Placed) {
        let next = &self.network.layers[k + 1].message;
        let (Some(tensor), lanes) = (&next.from, next.lanes()) else { return };
        let rows = placed.first * lanes..placed.places().end * lanes;
        for (tape, messages) in self.work.tapes.iter().zip(&mut self.layers[k + 1].messages) {
            send(tensor, lanes, &placed, tape, &mut messages[rows.clone()]);
        }
    }

    /// Goes through the readout and back to the densities of a batch, from the cotangents `seeds` of the derivative of each energy and
    /// of the energy.
    pub fn read_out(&mut self, seeds: [f64; 2], placed: Placed, sums: &mut WeightSums) {
        Instructions::best().run(ReadOutBatch { passes: self, seeds, placed, sums });
    }

    /// From the cotangents of the densities and messages of a batch, whose tapes are present, to those of what layer `k` received.
    pub fn backward(&mut self, k: usize, placed: Placed, sums: &mut LayerSums) {
        Instructions::best().run(BackwardBatch { passes: self, k, placed, sums });
    }
}

struct ForwardBatch<'a> {
    passes: &'a mut DualPasses,
    k: usize,
    placed: Placed,
}

impl SimdPass for ForwardBatch<'_> {
    #[inline(always)]
    fn run(self, _: bool) {
        let DualPasses { network, bonds, layers, work } = self.passes;
        let (layer, block) = (&network.layers[self.k], &network.readout.blocks[self.k]);
        let (batch, places, steps) = (&self.placed.batch, self.placed.places(), &layer.steps);
        let [tape, along] = &mut work.tapes;
        for tape in [&mut *tape, &mut *along] {
            grow(tape, batch.atoms * steps.tape_lanes);
            tape[..batch.atoms * steps.fixed_lanes].fill(Double::ZERO);
        }
        let LayerArrays { messages, densities: of_layer, .. } = &mut layers[self.k];
        let received = messages.each_ref().map(|rows| &rows[..]);
        for (slot, place) in places.clone().enumerate() {
            let tapes = ([&mut tape[..], &mut along[..]], TapeSlot { slot, slots: batch.atoms });
            accumulate(layer, batch.element, bonds.of_place(place), received, tapes, &mut work.block);
        }
        work.bases.iter_mut().for_each(|basis| grow(basis, batch.atoms * steps.basis_lanes));
        let [basis, basis_along] = &mut work.bases;
        steps.forward_derivative(batch, [tape, along], [basis, basis_along]);
        let lanes = network.readout.density_lanes();
        let rows = places.start * lanes..places.end * lanes;
        let out = of_layer.each_mut().map(|y| &mut y[rows.clone()]);
        densities(block.weights.forward(batch.element), batch, [basis, basis_along], out);
    }
}

struct ReadOutBatch<'a> {
    passes: &'a mut DualPasses,
    seeds: [f64; 2],
    placed: Placed,
    sums: &'a mut WeightSums,
}

impl SimdPass for ReadOutBatch<'_> {
    #[inline(always)]
    fn run(self, _: bool) {
        let DualPasses { network, layers, work, .. } = self.passes;
        let (readout, places) = (&network.readout, self.placed.places());
        let lanes = readout.density_lanes();
        let rows = places.start * lanes..places.end * lanes;
        let (mut densities, mut out) = (Vec::new(), Vec::new());
        for arrays in layers.iter_mut() {
            densities.push(arrays.densities.each_ref().map(|y| &y[rows.clone()]));
            out.push(arrays.of_densities.each_mut().map(|y| &mut y[rows.clone()]));
        }
        let work = (&mut work.readout, self.sums);
        read_out(readout, &self.placed.batch, self.seeds, &densities, &mut out, work);
    }
}

struct BackwardBatch<'a> {
    passes: &'a mut DualPasses,
    k: usize,
    placed: Placed,
    sums: &'a mut LayerSums,
}

impl SimdPass for BackwardBatch<'_> {
    #[inline(always)]
    fn run(self, _: bool) {
        let DualPasses { network, bonds, layers, work } = self.passes;
        let (layer, block) = (&network.layers[self.k], &network.readout.blocks[self.k]);
        let (batch, places, steps) = (&self.placed.batch, self.placed.places(), &layer.steps);
        let (atoms, slots) = (batch.atoms, 2 * batch.atoms);
        grow(&mut work.cotangent, slots * steps.cotangent_lanes);
        work.cotangent[..slots * steps.fixed_lanes].fill(Double::ZERO);
        let (here, after) = layers[self.k..].split_at_mut(1);
        let next = after.first().zip(network.layers.get(self.k + 1));
        if let Some((next, tensor)) =
            next.and_then(|(next, layer)| Some((next, layer.message.from.as_ref()?)))
        {
            add_message_cotangents(tensor, next, &self.placed, &mut work.cotangent);
        }
        let lanes = network.readout.density_lanes();
        let rows = places.start * lanes..places.end * lanes;
        let of_densities = here[0].of_densities.each_ref().map(|y| &y[rows.clone()]);
        basis_cotangents(block, &self.placed, steps.basis_lanes, of_densities, work, self.sums);
        let (tapes, of_bases) =
            (work.tapes.each_ref().map(|tape| &tape[..]), work.of_bases.each_ref().map(|rows| &rows[..]));
        steps.backward_derivative(batch, tapes, &mut work.cotangent, of_bases, &mut self.sums.steps);
        let LayerArrays { messages, returned, .. } = &mut here[0];
        for (slot, place) in places.enumerate() {
            let of_atom = [0, 1].map(|k| TapeSlot { slot: k * atoms + slot, slots });
            let received = messages.each_ref().map(|rows| &rows[..]);
            let cotangent = (&work.cotangent[..], of_atom);
            let to = (returned.each_mut().map(|rows| &mut rows[..]), &mut *self.sums);
            let own = bonds.of_place(place);
            reverse(layer, batch.element, own, received, cotangent, &mut work.block, to);
        }
    }
}

/// Adds the cotangents of the messages that `next` received from a batch, of derivatives and of values, to those of its tapes.
#[inline(always)]
fn add_message_cotangents(tensor: &Tensor, next: &LayerArrays, placed: &Placed, cotangent: &mut [Double]) {
    let (atoms, places) = (placed.batch.atoms, placed.places());
    let of_message = tensor.components * tensor.width;
    for (k, rows) in next.returned.iter().enumerate() {
        let rows = &rows[places.start * of_message..places.end * of_message];
        add_returned(tensor, rows, cotangent, (k * atoms, 2 * atoms));
    }
}

/// From the cotangents of the densities of a batch to those of its basis, of `basis_lanes` per atom, and of the weights between them.
#[inline(always)]
fn basis_cotangents(
    block: &ReadoutBlock<Double>,
    placed: &Placed,
    basis_lanes: usize,
    of_densities: [&[Double]; 2],
    work: &mut BatchWork,
    sums: &mut LayerSums,
) {
    let batch = &placed.batch;
    let weights = block.weights.transposed(batch.element);
    for (of_basis, of_densities) in work.of_bases.iter_mut().zip(of_densities) {
        of_basis.clear();
        of_basis.resize(batch.atoms * basis_lanes, Double::ZERO);
        multiply(weights, batch, of_densities, of_basis);
    }
    let of_rows = |stride| StridedRows::of_atoms(batch.atoms, stride);
    let (from, to) = (of_rows(basis_lanes), of_rows(block.lanes()));
    let [basis, basis_along] = &work.bases;
    let [of_along, of_values] = of_densities;
    sums.block.add_outer_products(batch.element, batch.atoms, (basis_along, from), (of_along, to));
    sums.block.add_outer_products(batch.element, batch.atoms, (basis, from), (of_values, to));
}
