//! The passes of one structure, batch by batch.

use std::sync::Arc;

use atoms::{Evaluation, Matrix3, NeighbourList, Potential, PotentialError, Structure, Vec3};

use super::super::batches::{Batches, Placed};
use super::super::bonds::{GraceBond, bonds_of};
use super::super::instructions::{Instructions, SimdPass};
use super::super::layer_passes::{add_returned, grow, send};
use super::super::matrix::StridedRows;
use super::super::network::Network;
use super::super::potential::Grace;
use super::super::tape::TapeSlot;
use super::super::vector::{Double, Vector};
use super::dual_bonds::{BlockWork, MovingBonds, accumulate, reverse};
use super::dual_readout::{DualReadoutWork, densities, multiply, read_out};
use super::sums::{LayerSums, WeightSums};

/// The derivatives of a loss L with respect to what a model says about a structure.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LossGradient {
    /// ∂L/∂E, 1/eV
    pub energy: f64,
    /// ∂L/∂F, `[n]`, Å/eV
    pub forces: Vec<Vec3>,
    /// ∂L/∂W, 1/eV, with the virial W of [`Evaluation`].
    pub virial: Matrix3,
}

/// How much more tape a batch may have than in an evaluation: each batch reads and writes the sums of all matrices.
const LARGER_BATCHES: usize = 8;

/// Computes derivatives with respect to weights, on one thread.
#[derive(Debug)]
pub struct GradientWorker {
    evaluator: Grace,
    evaluation: Evaluation,
    network: Arc<Network<Double>>,
    elements: Vec<usize>,
    batches: Batches,
    /// The bonds of the atom at each place, with the directions along which they change.
    offsets: Vec<usize>,
    bonds: Vec<GraceBond>,
    directions: Vec<Vec3>,
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

impl GradientWorker {
    pub(super) fn new(evaluator: Grace, network: Arc<Network<Double>>) -> Self {
        let layers = vec![LayerArrays::default(); network.layers.len()];
        Self {
            evaluator,
            evaluation: Evaluation::default(),
            network,
            elements: Vec::new(),
            batches: Batches::default(),
            offsets: Vec::new(),
            bonds: Vec::new(),
            directions: Vec::new(),
            layers,
            work: BatchWork::default(),
        }
    }

    /// Evaluates a structure, calls `loss` with the result, and adds the derivatives of the loss with respect to the
    /// weights to `sums`, which belong to the model of this worker. `neighbours` must be up to date.
    ///
    /// # Errors
    /// An unsupported element, or a neighbour list shorter than the model's cutoff.
    ///
    /// # Panics
    /// If the loss has not one force per atom.
    pub fn accumulate(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        loss: impl FnOnce(&Evaluation) -> LossGradient,
        sums: &mut WeightSums,
    ) -> Result<(), PotentialError> {
        self.evaluator.evaluate(structure, neighbours, &mut self.evaluation)?;
        let loss = loss(&self.evaluation);
        assert_eq!(loss.forces.len(), structure.species.len(), "one force per atom");
        self.evaluator.model().write_element_indices(&structure.species, &mut self.elements)?;
        self.take(structure, neighbours, &loss);
        let last = self.layers.len() - 1;
        (0..=last).for_each(|k| self.begin_layer(k));
        for k in 0..last {
            self.for_each_batch(|this, placed| {
                this.forward_batch(k, placed);
                this.send_batch(k, placed);
            });
        }
        // L changes by Ē E − D E.
        let seeds = [-1.0, loss.energy];
        self.for_each_batch(|this, placed| {
            this.forward_batch(last, placed);
            this.read_out_batch(seeds, placed, sums);
            this.backward_batch(last, placed, &mut sums.layers[last]);
        });
        for k in (0..last).rev() {
            self.for_each_batch(|this, placed| {
                this.forward_batch(k, placed);
                this.backward_batch(k, placed, &mut sums.layers[k]);
            });
        }
        Ok(())
    }

    /// Orders the atoms; collects their bonds and directions.
    fn take(&mut self, structure: &Structure, neighbours: &NeighbourList, loss: &LossGradient) {
        let Self { network, elements, batches, offsets, bonds, directions, .. } = self;
        batches.update(elements, network.tape_bytes() / LARGER_BATCHES);
        let radial = &network.layers[0].radial;
        offsets.clear();
        offsets.push(0);
        bonds.clear();
        directions.clear();
        for place in 0..elements.len() {
            let atom = batches.order[place] as usize;
            for bond in bonds_of(atom, radial, structure, neighbours, elements, batches) {
                let other = batches.order[bond.neighbour as usize] as usize;
                let (here, there, w) = (&loss.forces[atom], &loss.forces[other], &loss.virial);
                directions.push(std::array::from_fn(|a| {
                    let strained: f64 = (0..3).map(|b| 0.5 * (w[a][b] + w[b][a]) * bond.d[b]).sum();
                    there[a] - here[a] + strained
                }));
                bonds.push(bond);
            }
            offsets.push(bonds.len());
        }
    }

    /// Sizes the arrays of a layer; messages start as constants.
    fn begin_layer(&mut self, k: usize) {
        let (layer, n) = (&self.network.layers[k], self.elements.len());
        let arrays = &mut self.layers[k];
        let [messages, along] = &mut arrays.messages;
        messages.resize(n * layer.message.lanes(), Double::ZERO);
        along.clear();
        along.resize(messages.len(), Double::ZERO);
        for (atom, row) in self.batches.order.iter().zip(messages.chunks_exact_mut(layer.message.lanes())) {
            row.copy_from_slice(&layer.message.constants[self.elements[*atom as usize]]);
        }
        let passed = layer.message.passed() * layer.density.width;
        for returned in &mut arrays.returned {
            returned.clear();
            returned.resize(n * passed, Double::ZERO);
        }
        let lanes = self.network.readout.density_lanes();
        for rows in arrays.densities.iter_mut().chain(&mut arrays.of_densities) {
            rows.resize(n * lanes, Double::ZERO);
        }
    }

    fn for_each_batch(&mut self, mut of_batch: impl FnMut(&mut Self, Placed)) {
        for batch in 0..self.batches.batches.len() {
            let placed = self.batches.placed(batch, Instructions::best());
            of_batch(self, placed);
        }
    }

    /// Computes tapes, bases and densities of a batch.
    fn forward_batch(&mut self, k: usize, placed: Placed) {
        Instructions::best().run(ForwardBatch { worker: self, k, placed });
    }

    /// Adds the results of a batch to its messages to the next layer.
    fn send_batch(&mut self, k: usize, placed: Placed) {
        let next = &self.network.layers[k + 1].message;
        let (Some(tensor), lanes) = (&next.from, next.lanes()) else { return };
        let rows = placed.first * lanes..placed.places().end * lanes;
        for (tape, messages) in self.work.tapes.iter().zip(&mut self.layers[k + 1].messages) {
            send(tensor, lanes, &placed, tape, &mut messages[rows.clone()]);
        }
    }

    fn read_out_batch(&mut self, seeds: [f64; 2], placed: Placed, sums: &mut WeightSums) {
        Instructions::best().run(ReadOutBatch { worker: self, seeds, placed, sums });
    }

    /// From the cotangents of the densities and messages of a batch, whose tapes are present.
    fn backward_batch(&mut self, k: usize, placed: Placed, sums: &mut LayerSums) {
        Instructions::best().run(BackwardBatch { worker: self, k, placed, sums });
    }
}

struct ForwardBatch<'a> {
    worker: &'a mut GradientWorker,
    k: usize,
    placed: Placed,
}

impl SimdPass for ForwardBatch<'_> {
    #[inline(always)]
    fn run(self, _: bool) {
        let GradientWorker { network, offsets, bonds, directions, layers, work, .. } = self.worker;
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
            let own = offsets[place]..offsets[place + 1];
            let own = MovingBonds { bonds: &bonds[own.clone()], directions: &directions[own] };
            let tapes = ([&mut tape[..], &mut along[..]], TapeSlot { slot, slots: batch.atoms });
            accumulate(layer, batch.element, own, received, tapes, &mut work.block);
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
    worker: &'a mut GradientWorker,
    seeds: [f64; 2],
    placed: Placed,
    sums: &'a mut WeightSums,
}

impl SimdPass for ReadOutBatch<'_> {
    #[inline(always)]
    fn run(self, _: bool) {
        let GradientWorker { network, layers, work, .. } = self.worker;
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
    worker: &'a mut GradientWorker,
    k: usize,
    placed: Placed,
    sums: &'a mut LayerSums,
}

impl SimdPass for BackwardBatch<'_> {
    #[inline(always)]
    fn run(self, _: bool) {
        let GradientWorker { network, offsets, bonds, directions, layers, work, .. } = self.worker;
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
            let of_message = tensor.components * tensor.width;
            for (k, rows) in next.returned.iter().enumerate() {
                let rows = &rows[places.start * of_message..places.end * of_message];
                add_returned(tensor, rows, &mut work.cotangent, (k * atoms, slots));
            }
        }
        let lanes = network.readout.density_lanes();
        let rows = places.start * lanes..places.end * lanes;
        let of_densities = here[0].of_densities.each_ref().map(|y| &y[rows.clone()]);
        for (of_basis, of_densities) in work.of_bases.iter_mut().zip(of_densities) {
            of_basis.clear();
            of_basis.resize(atoms * steps.basis_lanes, Double::ZERO);
            multiply(block.weights.transposed(batch.element), batch, of_densities, of_basis);
        }
        let of_rows = |stride| StridedRows::of_atoms(atoms, stride);
        let (from, to) = (of_rows(steps.basis_lanes), of_rows(lanes));
        let [basis, basis_along] = &work.bases;
        let [of_along, of_values] = of_densities;
        self.sums.block.add_outer_products(batch.element, atoms, (basis_along, from), (of_along, to));
        self.sums.block.add_outer_products(batch.element, atoms, (basis, from), (of_values, to));
        let (tapes, of_bases) =
            (work.tapes.each_ref().map(|tape| &tape[..]), work.of_bases.each_ref().map(|rows| &rows[..]));
        steps.backward_derivative(batch, tapes, &mut work.cotangent, of_bases, &mut self.sums.steps);
        let LayerArrays { messages, returned, .. } = &mut here[0];
        for (slot, place) in places.enumerate() {
            let own = offsets[place]..offsets[place + 1];
            let own = MovingBonds { bonds: &bonds[own.clone()], directions: &directions[own] };
            let of_atom = [0, 1].map(|k| TapeSlot { slot: k * atoms + slot, slots });
            let received = messages.each_ref().map(|rows| &rows[..]);
            let cotangent = (&work.cotangent[..], of_atom);
            let to = (returned.each_mut().map(|rows| &mut rows[..]), &mut *self.sums);
            reverse(layer, batch.element, own, received, cotangent, &mut work.block, to);
        }
    }
}
