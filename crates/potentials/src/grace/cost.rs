//! Counts arithmetic operations.

use super::evaluate::Evaluator;
use super::layer::Layer;
use super::product::Coupled;
use super::radial_table::SUPPORT;
use super::tape::TapeOperation;
use super::vector::Vector;
use super::weights::Weights;

impl<V: Vector> Evaluator<V> {
    /// As [`super::Grace::multiply_adds`].
    pub fn multiply_adds(&self, with_features: bool) -> u64 {
        let (network, cotangents) = (&*self.network, 1 + u64::from(with_features));
        let atoms = self.atomic_energies().len() as u64;
        let maps = network.readout.blocks.iter().map(|block| &block.weights);
        let mut of_atom = 2 * maps.map(size).sum::<u64>();
        of_atom += 2 * network.readout.layers.iter().map(|layer| layer.forward(0).size()).sum::<u64>();
        if let Some(projection) = network.projection().filter(|_| with_features) {
            of_atom += 2 * projection.matrix.len() as u64;
        }
        let mut of_bonds = 0;
        for (layer, bonds) in network.layers.iter().zip(self.bonds()) {
            of_bonds += bonds as u64 * of_bond(layer, cotangents);
            of_atom +=
                layer.steps.operations().map(|operation| of_operation(operation, cotangents)).sum::<u64>();
        }
        atoms * of_atom + of_bonds
    }
}

fn size<V: Vector>(weights: &Weights<V>) -> u64 {
    weights.forward(0).size()
}

fn of_bond<V: Vector>(layer: &Layer<V>, cotangents: u64) -> u64 {
    let (functions, channels) = (layer.harmonics.len() as u64, layer.density.channels as u64);
    let radial = 2 * SUPPORT as u64 * (layer.harmonics.lmax() as u64 + 1) * channels;
    let (components, passed) = (layer.message.components as u64, layer.message.passed() as u64);
    let forward = functions * channels * components;
    let backward = match passed {
        0 => 2,
        _ => components + 2 + passed,
    };
    radial + forward + cotangents * backward * functions * channels
}

fn of_operation<V: Vector>(operation: &TapeOperation<V>, cotangents: u64) -> u64 {
    let terms = |coupled: &[Coupled<V>]| coupled.iter().map(|c| c.terms.len() as u64).sum::<u64>();
    match operation {
        TapeOperation::Linear(linear) => {
            let parts = linear.parts.iter().map(|part| part.tape[0].len() as u64 * size(&part.weights));
            (1 + cotangents) * parts.sum::<u64>()
        }
        TapeOperation::Product(product) => {
            product.channels as u64 * (terms(&product.outputs) + cotangents * terms(&product.inputs))
        }
        TapeOperation::Combination(combination) => {
            let terms = combination.outputs.iter().map(|(_, terms)| terms.len() as u64).sum::<u64>();
            combination.channels as u64 * terms * (1 + cotangents)
        }
        TapeOperation::EquivariantNorm(_) => 0,
    }
}
