//! The forward pass and the reverse sweep of one layer.

use atoms::{Evaluation, Matrix3, Vec3};

use super::bonds::{Bond, BondWork, Bonds};
use super::evaluate::PullBack;
use super::layer::{Layer, Message};
use super::matrix::{Lanes, ZERO, add_scaled};
use super::messages::Messages;
use super::model::GraceModel;

/// Work arrays of one layer.
#[derive(Clone, Debug)]
pub(super) struct LayerWork {
    pub bonds: Bonds,
    /// m, [n, lanes of a message]; empty in the first layer.
    messages: Vec<Lanes>,
    /// Cotangents of what depends on the layer before, from the energy and from the features, [n, lanes].
    message_cotangents: [Vec<Lanes>; 2],
    /// [n, tape]
    tapes: Vec<Lanes>,
    /// Cotangent of one atom's basis from the energy.
    energy_basis_cotangent: Vec<Lanes>,
    /// Cotangent tapes of one atom, for the energy and for the features.
    cotangent_tapes: [Vec<Lanes>; 2],
    bond_work: BondWork,
}

/// Where the cotangents of one layer's part of the basis come from.
pub(super) struct BasisCotangents<'a> {
    pub model: &'a GraceModel,
    pub layer: usize,
    /// ∂E/∂(W B), [n, lanes of the densities]
    pub densities: &'a [Lanes],
    /// [n, lanes of the basis]
    pub from_features: &'a [Lanes],
}

impl BasisCotangents<'_> {
    #[inline(always)]
    fn of_energy(&self, i: usize, element: usize, out: &mut [Lanes]) {
        let readout = &self.model.readout;
        let densities = &self.densities[i * readout.density_lanes()..][..readout.density_lanes()];
        out.fill(ZERO);
        readout.basis_cotangent(self.layer, element, densities, out);
    }

    #[inline(always)]
    fn of_features(&self, i: usize) -> &[Lanes] {
        let basis = &self.from_features[i * self.model.basis_lanes()..];
        &basis[self.model.basis_start(self.layer)..self.model.basis_ends[self.layer]]
    }
}

impl LayerWork {
    pub fn new(layer: &Layer) -> Self {
        Self {
            bonds: Bonds::default(),
            messages: Vec::new(),
            message_cotangents: Default::default(),
            tapes: Vec::new(),
            energy_basis_cotangent: vec![ZERO; layer.basis.lanes()],
            cotangent_tapes: std::array::from_fn(|_| vec![ZERO; layer.tape_lanes]),
            bond_work: BondWork::new(layer),
        }
    }

    /// The messages of all atoms from the tapes of the layer before.
    #[inline(always)]
    pub fn take_messages(
        &mut self,
        layer: &Layer,
        elements: &[usize],
        before: &LayerWork,
        layer_before: &Layer,
    ) {
        let Some(tensor) = layer.message.from else { return };
        self.messages.resize(elements.len() * layer.message.lanes(), ZERO);
        let messages = self.messages.chunks_exact_mut(layer.message.lanes());
        let tapes = before.tapes.chunks_exact(layer_before.tape_lanes);
        for ((element, message), tape) in elements.iter().zip(messages).zip(tapes) {
            message.copy_from_slice(&layer.message.constants[*element]);
            for (m, x) in message.iter_mut().zip(&tape[tensor.start..tensor.end()]) {
                add_scaled(m, 1.0, x);
            }
        }
    }

    /// Tapes of all atoms, and their part of the basis into `bases`, where it begins at the first lane of
    /// `place` in each atom's row of as many lanes as the second says.
    #[inline(always)]
    pub fn forward(
        &mut self,
        layer: &Layer,
        elements: &[usize],
        bases: &mut [Lanes],
        (start, basis_lanes): (usize, usize),
    ) {
        self.tapes.resize(elements.len() * layer.tape_lanes, ZERO);
        for (i, element) in elements.iter().enumerate() {
            let tape = &mut self.tapes[i * layer.tape_lanes..(i + 1) * layer.tape_lanes];
            tape.fill(ZERO);
            let density = &mut tape[..layer.density.end()];
            let (bonds, work) = (&mut self.bonds, &mut self.bond_work);
            match layer.message.from {
                None => bonds.accumulate(i, layer, *element, density, work),
                Some(_) => bonds.accumulate_messages(i, layer, *element, &self.messages, density, work),
            }
            for operation in &layer.operations {
                operation.forward(*element, tape);
            }
            layer.basis.forward(tape, &mut bases[i * basis_lanes + start..]);
        }
    }

    /// Atom by atom back along the tape, then along the bonds. `returned` is the message of the next layer
    /// and the work that holds its cotangents.
    #[inline(always)]
    pub fn backward<const N: usize>(
        &mut self,
        elements: &[usize],
        basis: &BasisCotangents,
        returned: Option<(&Message, &LayerWork)>,
        energy: &mut Evaluation,
        pull_back: &mut PullBack,
    ) {
        let layer = &basis.model.layers[basis.layer];
        for cotangents in &mut self.message_cotangents[..N] {
            cotangents.clear();
            cotangents.resize(elements.len() * layer.message.passed() * layer.density.width, ZERO);
        }
        for (i, element) in elements.iter().enumerate() {
            let tape = &self.tapes[i * layer.tape_lanes..(i + 1) * layer.tape_lanes];
            basis.of_energy(i, *element, &mut self.energy_basis_cotangent);
            for (k, cotangent) in self.cotangent_tapes.iter_mut().enumerate().take(N) {
                cotangent.fill(ZERO);
                let of_basis = if k == 0 { &self.energy_basis_cotangent } else { basis.of_features(i) };
                layer.basis.backward(of_basis, cotangent);
                if let Some((message, after)) = returned {
                    add_returned(message, i, &after.message_cotangents[k], cotangent);
                }
                for operation in layer.operations.iter().rev() {
                    operation.backward(*element, tape, cotangent);
                }
            }
            self.backward_bonds::<N>(i, layer, energy, pull_back);
        }
    }

    #[inline(always)]
    fn backward_bonds<const N: usize>(
        &mut self,
        i: usize,
        layer: &Layer,
        energy: &mut Evaluation,
        pull_back: &mut PullBack,
    ) {
        let densities: [&[Lanes]; N] =
            std::array::from_fn(|k| &self.cotangent_tapes[k][..layer.density.end()]);
        let sink = |bond: &Bond, gradients: [Vec3; N]| {
            let j = bond.neighbour as usize;
            add_bond(&mut energy.forces, &mut energy.virial, j, i, bond.d, gradients[0]);
            if N == 2 {
                add_bond(&mut pull_back.gradient, &mut pull_back.virial, i, j, bond.d, gradients[N - 1]);
            }
        };
        let (bonds, work) = (&self.bonds, &mut self.bond_work);
        if layer.message.from.is_none() {
            return bonds.reverse(i, layer, densities, work, sink);
        }
        let cotangents = self.message_cotangents.each_mut().map(Vec::as_mut_slice);
        let messages = Messages { sent: &self.messages, cotangents };
        bonds.reverse_messages(i, layer, densities, messages, work, sink);
    }
}

/// Adds the cotangent of atom `i`'s message to its cotangent tape.
#[inline(always)]
fn add_returned(message: &Message, i: usize, cotangents: &[Lanes], tape: &mut [Lanes]) {
    let Some(tensor) = message.from else { return };
    let lanes = tensor.end() - tensor.start;
    for (x, c) in tape[tensor.start..tensor.end()].iter_mut().zip(&cotangents[i * lanes..]) {
        add_scaled(x, 1.0, c);
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
