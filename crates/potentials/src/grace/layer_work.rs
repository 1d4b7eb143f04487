//! The forward pass and the reverse sweep of one layer, batch by batch.

use std::ops::Range;

use atoms::{Evaluation, Matrix3, Vec3};

use super::batches::Placed;
use super::bonds::{Bond, BondWork, Bonds};
use super::evaluate::PullBack;
use super::layer::{Layer, Message};
use super::matrix::{Lanes, Rows, ZERO, add_scaled};
use super::messages::Messages;
use super::readout::Block;
use super::tape::Slot;

/// Work arrays of one layer. Atoms stand in the order in which they are evaluated, but for messages, which stand in the
/// order of the structure.
#[derive(Clone, Debug)]
pub(super) struct LayerWork {
    pub bonds: Bonds,
    /// What the arrays below hold.
    held: Range<usize>,
    /// The tape of one batch after another, [held places, tape]
    tapes: Vec<Lanes>,
    /// The basis B of this layer, [held places, lanes]
    pub bases: Vec<Lanes>,
    /// Its cotangent from the features, [held places, lanes]
    pub basis_cotangents: Vec<Lanes>,
    /// ∂E/∂(W B), [held places, lanes of the densities]
    pub density_cotangents: Vec<Lanes>,
    /// m, [n, lanes of a message]; empty in the first layer.
    messages: Vec<Lanes>,
    /// Cotangents of what depends on the layer before, from the energy and from the features, [n, lanes].
    message_cotangents: [Vec<Lanes>; 2],
    /// Cotangents of the basis from the energy, of one batch.
    energy_basis_cotangents: Vec<Lanes>,
    /// Cotangents of the tape for the energy and for the features, of one batch.
    cotangent_tape: Vec<Lanes>,
    bond_work: BondWork,
}

/// The part of an array with `lanes` for each place that belongs to a batch.
#[inline(always)]
fn part(held: &Range<usize>, placed: &Placed, lanes: usize) -> Range<usize> {
    let first = placed.first - held.start;
    first * lanes..(first + placed.batch.atoms) * lanes
}

impl LayerWork {
    pub fn new(layer: &Layer) -> Self {
        Self {
            bonds: Bonds::default(),
            held: 0..0,
            tapes: Vec::new(),
            bases: Vec::new(),
            basis_cotangents: Vec::new(),
            density_cotangents: Vec::new(),
            messages: Vec::new(),
            message_cotangents: Default::default(),
            energy_basis_cotangents: Vec::new(),
            cotangent_tape: Vec::new(),
            bond_work: BondWork::new(layer),
        }
    }

    /// Makes room for the atoms at some places, and forgets others.
    pub fn hold(&mut self, layer: &Layer, block: &Block, places: Range<usize>) {
        let grow = |lanes: &mut Vec<Lanes>, of_one: usize| {
            if lanes.len() < places.len() * of_one {
                lanes.resize(places.len() * of_one, ZERO);
            }
        };
        grow(&mut self.tapes, layer.tape_lanes);
        grow(&mut self.bases, layer.basis.lanes());
        grow(&mut self.density_cotangents, block.lanes());
        self.bonds.hold(layer, places.clone());
        self.held = places;
    }

    /// The basis of the atoms of a batch, a row each.
    #[inline(always)]
    pub fn basis(&self, layer: &Layer, placed: &Placed) -> &[Lanes] {
        &self.bases[part(&self.held, placed, layer.basis.lanes())]
    }

    /// ∂E/∂(W B) of the atoms of a batch, a row each.
    #[inline(always)]
    pub fn densities(&mut self, block: &Block, placed: &Placed) -> &mut [Lanes] {
        &mut self.density_cotangents[part(&self.held, placed, block.lanes())]
    }

    /// The messages of all `n` atoms before the layer before has added what depends on their surroundings.
    #[inline(always)]
    pub fn begin_messages(&mut self, layer: &Layer, elements: &[usize]) {
        if layer.message.from.is_none() {
            return;
        }
        self.messages.resize(elements.len() * layer.message.lanes(), ZERO);
        for (element, message) in elements.iter().zip(self.messages.chunks_exact_mut(layer.message.lanes())) {
            message.copy_from_slice(&layer.message.constants[*element]);
        }
    }

    /// Adds what the tapes of a batch in the layer before say.
    #[inline(always)]
    pub fn take_messages(
        &mut self,
        layer: &Layer,
        placed: &Placed,
        before: &LayerWork,
        layer_before: &Layer,
    ) {
        let Some(tensor) = layer.message.from else { return };
        let tape = &before.tapes[part(&before.held, placed, layer_before.tape_lanes)];
        for (place, i) in placed.atoms() {
            let slot = Slot { slot: place - placed.first, slots: placed.batch.atoms };
            let message = &mut self.messages[i * layer.message.lanes()..][..layer.message.lanes()];
            for (q, row) in message.chunks_exact_mut(tensor.width).take(tensor.components).enumerate() {
                for (m, x) in row.iter_mut().zip(&tape[slot.row(&tensor, q)..]) {
                    add_scaled(m, 1.0, x);
                }
            }
        }
    }

    /// Tapes of a batch, and its part of the basis.
    #[inline(always)]
    pub fn forward(&mut self, layer: &Layer, placed: &Placed) {
        let batch = &placed.batch;
        let tape = &mut self.tapes[part(&self.held, placed, layer.tape_lanes)];
        layer.used.clear(batch.atoms, tape);
        for slot in 0..batch.atoms {
            let density = (&mut *tape, Slot { slot, slots: batch.atoms });
            let (bonds, work, place) = (&mut self.bonds, &mut self.bond_work, placed.first + slot);
            match layer.message.from {
                None => bonds.accumulate(place, layer, batch.element, density, work),
                Some(_) => {
                    bonds.accumulate_messages(place, layer, batch.element, &self.messages, density, work);
                }
            }
        }
        for operation in &layer.operations {
            operation.forward(batch, tape);
        }
        let lanes = layer.basis.lanes();
        layer.basis.forward(batch.atoms, tape, &mut self.bases[part(&self.held, placed, lanes)], lanes);
    }

    /// Sets the cotangents of `n` messages to zero.
    #[inline(always)]
    pub fn begin_backward<const N: usize>(&mut self, layer: &Layer, n: usize) {
        for cotangents in &mut self.message_cotangents[..N] {
            cotangents.clear();
            cotangents.resize(n * layer.message.passed() * layer.density.width, ZERO);
        }
    }

    /// A batch back along the tape, then along the bonds. `returned` is the message of the next layer
    /// and the work that holds its cotangents.
    #[inline(always)]
    pub fn backward<const N: usize>(
        &mut self,
        layer: &Layer,
        block: &Block,
        placed: &Placed,
        returned: Option<(&Message, &LayerWork)>,
        energy: &mut Evaluation,
        pull_back: &mut PullBack,
    ) {
        let (batch, lanes) = (&placed.batch, layer.basis.lanes());
        let (atoms, slots) = (batch.atoms, N * batch.atoms);
        let mut cotangent = std::mem::take(&mut self.cotangent_tape);
        if cotangent.len() < slots * layer.tape_lanes {
            cotangent.resize(slots * layer.tape_lanes, ZERO);
        }
        layer.used.clear(slots, &mut cotangent);
        self.energy_basis_cotangent(block, placed, lanes);
        layer.basis.backward(atoms, (&self.energy_basis_cotangents, lanes), &mut cotangent, (0, slots));
        if N == 2 {
            let of_features = &self.basis_cotangents[part(&self.held, placed, lanes)];
            layer.basis.backward(atoms, (of_features, lanes), &mut cotangent, (atoms, slots));
        }
        if let Some((message, after)) = returned {
            for (k, cotangents) in after.message_cotangents.iter().enumerate().take(N) {
                for (place, i) in placed.atoms() {
                    let slot = Slot { slot: k * atoms + place - placed.first, slots };
                    add_returned(message, i, cotangents, &mut cotangent, slot);
                }
            }
        }
        let tape = &self.tapes[part(&self.held, placed, layer.tape_lanes)];
        for operation in layer.operations.iter().rev() {
            operation.backward::<N>(batch, tape, &mut cotangent);
        }
        for (place, i) in placed.atoms() {
            let slot = |k: usize| Slot { slot: k * atoms + place - placed.first, slots };
            let cotangent = (&cotangent[..], std::array::from_fn(slot));
            self.backward_bonds::<N>(place, i, layer, cotangent, energy, pull_back);
        }
        self.cotangent_tape = cotangent;
    }

    /// ∂E/∂B of a batch.
    #[inline(always)]
    fn energy_basis_cotangent(&mut self, block: &Block, placed: &Placed, lanes: usize) {
        let atoms = placed.batch.atoms;
        let mut out = std::mem::take(&mut self.energy_basis_cotangents);
        out.clear();
        out.resize(atoms * lanes, ZERO);
        let (from, to) = (Rows::of_atoms(atoms, block.lanes()), Rows::of_atoms(atoms, lanes));
        let densities = self.densities(block, placed);
        let weights = block.weights.transposed(placed.batch.element);
        weights.multiply_add(densities, from, &mut out, to, placed.batch.instructions);
        self.energy_basis_cotangents = out;
    }

    #[inline(always)]
    fn backward_bonds<const N: usize>(
        &mut self,
        place: usize,
        i: usize,
        layer: &Layer,
        cotangent: (&[Lanes], [Slot; N]),
        energy: &mut Evaluation,
        pull_back: &mut PullBack,
    ) {
        let sink = |bond: &Bond, gradients: [Vec3; N]| {
            let j = bond.neighbour as usize;
            add_bond(&mut energy.forces, &mut energy.virial, j, i, bond.d, gradients[0]);
            if N == 2 {
                add_bond(&mut pull_back.gradient, &mut pull_back.virial, i, j, bond.d, gradients[N - 1]);
            }
        };
        let (bonds, work) = (&self.bonds, &mut self.bond_work);
        if layer.message.from.is_none() {
            return bonds.reverse(place, layer, cotangent, work, sink);
        }
        let cotangents = self.message_cotangents.each_mut().map(Vec::as_mut_slice);
        let messages = Messages { sent: &self.messages, cotangents };
        bonds.reverse_messages(place, layer, cotangent, messages, work, sink);
    }
}

/// Adds the cotangent of atom `i`'s message to its cotangent tape.
#[inline(always)]
fn add_returned(message: &Message, i: usize, cotangents: &[Lanes], tape: &mut [Lanes], slot: Slot) {
    let Some(tensor) = message.from else { return };
    let lanes = tensor.components * tensor.width;
    for (q, row) in cotangents[i * lanes..][..lanes].chunks_exact(tensor.width).enumerate() {
        for (x, c) in tape[slot.row(&tensor, q)..].iter_mut().zip(row) {
            add_scaled(x, 1.0, c);
        }
    }
}

/// With g = ∂/∂d: `gradient` loses g at `less` and gains it at `more`; `virial` gains g ⊗ d.
#[inline(always)]
pub(super) fn add_bond(
    gradient: &mut [Vec3],
    virial: &mut Matrix3,
    less: usize,
    more: usize,
    d: Vec3,
    g: Vec3,
) {
    for a in 0..3 {
        gradient[less][a] -= g[a];
        gradient[more][a] += g[a];
        for b in 0..3 {
            virial[a][b] += g[a] * d[b];
        }
    }
}
