//! The derivatives of the loss of one structure.

use std::sync::Arc;

use atoms::{Evaluation, NeighbourList, Potential, PotentialError, Structure};

use super::super::batches::{Batches, Placed};
use super::super::instructions::Instructions;
use super::super::network::Network;
use super::super::potential::Grace;
use super::super::vector::Double;
use super::dual_passes::DualPasses;
use super::moving_bonds::LossGradient;
use super::sums::WeightSums;

/// How much more tape a batch may have than in an evaluation: each batch reads and writes the sums of all matrices.
const LARGER_BATCHES: usize = 8;

/// Computes derivatives with respect to weights, on one thread.
#[derive(Debug)]
pub struct GradientWorker {
    evaluator: Grace,
    evaluation: Evaluation,
    elements: Vec<usize>,
    batches: Batches,
    passes: DualPasses,
}

impl GradientWorker {
    pub(super) fn new(evaluator: Grace, network: Arc<Network<Double>>) -> Self {
        Self {
            evaluator,
            evaluation: Evaluation::default(),
            elements: Vec::new(),
            batches: Batches::default(),
            passes: DualPasses::new(network),
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
        self.begin(structure, neighbours, &loss);
        let last = self.passes.network.layers.len() - 1;
        for k in 0..last {
            self.for_each_batch(|passes, placed| {
                passes.forward(k, placed);
                passes.send(k, placed);
            });
        }
        // L changes by Ē E − D E.
        let seeds = [-1.0, loss.energy];
        self.for_each_batch(|passes, placed| {
            passes.forward(last, placed);
            passes.read_out(seeds, placed, sums);
            passes.backward(last, placed, &mut sums.layers[last]);
        });
        for k in (0..last).rev() {
            self.for_each_batch(|passes, placed| {
                passes.forward(k, placed);
                passes.backward(k, placed, &mut sums.layers[k]);
            });
        }
        Ok(())
    }

    /// Orders the atoms; collects their bonds and directions.
    fn begin(&mut self, structure: &Structure, neighbours: &NeighbourList, loss: &LossGradient) {
        let Self { elements, batches, passes, .. } = self;
        batches.update(elements, passes.network.tape_bytes() / LARGER_BATCHES);
        let radial = &passes.network.layers[0].radial;
        passes.bonds.update(radial, structure, neighbours, (&*elements, &*batches), loss);
        passes.begin(elements, batches);
    }

    fn for_each_batch(&mut self, mut of_batch: impl FnMut(&mut DualPasses, Placed)) {
        for batch in 0..self.batches.batches.len() {
            let placed = self.batches.placed(batch, Instructions::best());
            of_batch(&mut self.passes, placed);
        }
    }
}
