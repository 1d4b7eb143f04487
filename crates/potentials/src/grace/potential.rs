//! A GRACE model as a potential, in the precision of its weights.

use std::sync::Arc;

use atoms::{Evaluation, NeighbourList, Potential, PotentialError, Species, Structure};

use super::evaluate::{Evaluator, Grade, PullBack};
use super::instructions::Instructions;
use super::model::GraceModel;
use super::network::AnyNetwork;
use super::threads::Threads;
use super::vector::{Double, Single};

/// A GRACE model with its work arrays; after the first step it allocates no more.
///
/// [`Grace::forward`] gives energies and features, then [`Grace::backward`] the derivatives at the same
/// structure. Results do not depend on the number of threads.
#[derive(Debug)]
pub struct Grace(AnyEvaluator);

#[derive(Debug)]
enum AnyEvaluator {
    Double(Evaluator<Double>),
    Mixed(Evaluator<Single>),
}

/// The same of whichever evaluator it is.
macro_rules! either {
    ($any:expr, $evaluator:ident => $result:expr) => {
        match $any {
            AnyEvaluator::Double($evaluator) => $result,
            AnyEvaluator::Mixed($evaluator) => $result,
        }
    };
}

impl Grace {
    /// An evaluator of `model` on the calling thread; nothing is computed yet.
    pub fn new(model: Arc<GraceModel>) -> Self {
        Self::with(model, Instructions::best(), Threads::default())
    }

    /// As [`Grace::new`], with these vector instructions and threads; results do not depend on them.
    pub fn with(model: Arc<GraceModel>, instructions: Instructions, threads: Threads) -> Self {
        Self(match model.network.clone() {
            AnyNetwork::Double(network) => {
                AnyEvaluator::Double(Evaluator::new(model, network, instructions, threads))
            }
            AnyNetwork::Mixed(network) => {
                AnyEvaluator::Mixed(Evaluator::new(model, network, instructions, threads))
            }
        })
    }

    /// The weights.
    pub fn model(&self) -> &Arc<GraceModel> {
        either!(&self.0, evaluator => evaluator.model())
    }

    /// Computes atomic energies and features z of `structure`.
    ///
    /// `neighbours` must be up to date for it.
    ///
    /// # Errors
    /// An element the model does not know, or a neighbour list shorter than [`GraceModel::cutoff`].
    pub fn forward(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
    ) -> Result<(), PotentialError> {
        either!(&mut self.0, evaluator => evaluator.forward(structure, neighbours))
    }

    /// Energies, features and the derivatives of both (without `pull_back` those of the energy alone), as [`Grace::forward`] and
    /// [`Grace::backward`] give them, with the same bits, where the cotangent ∂H/∂z of an atom depends on its own features alone: `grade` is called with some atoms at a
    /// time, by all threads. Models of one layer need a bounded memory for it, deeper ones less than for the two calls.
    ///
    /// # Errors
    /// As [`Grace::forward`].
    pub fn evaluate_graded(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        grade: &Grade,
        energy: &mut Evaluation,
        pull_back: Option<&mut PullBack>,
    ) -> Result<(), PotentialError> {
        either!(&mut self.0, evaluator => {
            evaluator.evaluate_graded(structure, neighbours, grade, energy, pull_back)
        })
    }

    /// Energy of each atom at the last [`Grace::forward`], [n], eV.
    pub fn atomic_energies(&self) -> &[f64] {
        either!(&self.0, evaluator => evaluator.atomic_energies())
    }

    /// Features z at the last [`Grace::forward`], [n, D] row-major; empty for a model without them.
    pub fn features(&self) -> &[f64] {
        either!(&self.0, evaluator => evaluator.features())
    }

    /// The derivatives at the structure of the last [`Grace::forward`], in one reverse sweep: of the
    /// energy into `energy`, and, where a cotangent ∂H/∂z [n, D] is given, of H into `pull_back`
    /// (zero otherwise).
    ///
    /// # Panics
    /// If the cotangent is not as long as [`Grace::features`].
    pub fn backward(
        &mut self,
        feature_cotangent: Option<&[f64]>,
        energy: &mut Evaluation,
        pull_back: &mut PullBack,
    ) {
        either!(&mut self.0, evaluator => evaluator.backward(feature_cotangent, energy, pull_back));
    }

    /// Multiply-adds of a call at the structure of the last one, for all atoms: energies and forces, or with them the
    /// features and the pull-back of their cotangents. Counted are sums of products over channels, bonds and couplings
    /// without padding and with tables of radial functions; spherical harmonics, norms and activations are not.
    pub fn multiply_adds(&self, with_features: bool) -> u64 {
        either!(&self.0, evaluator => evaluator.multiply_adds(with_features))
    }
}

impl Potential for Grace {
    fn cutoff(&self) -> f64 {
        self.model().cutoff()
    }

    fn species(&self) -> &[Species] {
        self.model().elements()
    }

    fn evaluate(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        either!(&mut self.0, evaluator => evaluator.evaluate(structure, neighbours, out))
    }
}
