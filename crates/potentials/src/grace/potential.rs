//! A GRACE model as a potential.

use std::sync::Arc;

use atoms::{Evaluation, NeighbourList, Potential, PotentialError, Species, Structure};

use super::evaluate::{Evaluator, GradeFunction, PullBack};
use super::instructions::Instructions;
use super::model::GraceModel;
use super::network::AnyNetwork;
use super::threads::Threads;
use super::vector::{Double, Single};

/// A GRACE model with its scratch arrays; it does not allocate after the first step.
///
/// [`Grace::forward`] computes energies and features, then [`Grace::backward`] the derivatives for the same
/// structure. Results do not depend on the number of threads.
#[derive(Debug)]
pub struct Grace(AnyEvaluator);

#[derive(Debug)]
enum AnyEvaluator {
    Double(Evaluator<Double>),
    Mixed(Evaluator<Single>),
}

/// Applies an expression to either evaluator.
macro_rules! either {
    ($any:expr, $evaluator:ident => $result:expr) => {
        match $any {
            AnyEvaluator::Double($evaluator) => $result,
            AnyEvaluator::Mixed($evaluator) => $result,
        }
    };
}

impl Grace {
    /// An evaluator of `model` on the calling thread.
    pub fn new(model: Arc<GraceModel>) -> Self {
        Self::with(model, Instructions::best(), Threads::default())
    }

    /// An evaluator with these vector instructions and threads; results do not depend on them.
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

    /// The model.
    pub fn model(&self) -> &Arc<GraceModel> {
        either!(&self.0, evaluator => evaluator.model())
    }

    /// Computes atomic energies and features z of `structure`.
    ///
    /// `neighbours` must be up to date for it.
    ///
    /// # Errors
    /// An unsupported element, or a neighbour list shorter than [`GraceModel::cutoff`].
    pub fn forward(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
    ) -> Result<(), PotentialError> {
        either!(&mut self.0, evaluator => evaluator.forward(structure, neighbours))
    }

    /// Energies, features and the derivatives of both (without `pull_back` those of the energy only), with the
    /// same bits as [`Grace::forward`] and [`Grace::backward`], for a cotangent ∂H/∂z of each atom that depends
    /// on its own features only. All threads call `grade`, each time with some of the atoms. One-layer models
    /// need bounded memory for this, deeper ones less than the two separate calls.
    ///
    /// # Errors
    /// As [`Grace::forward`].
    pub fn evaluate_graded(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        grade: &GradeFunction,
        energy: &mut Evaluation,
        pull_back: Option<&mut PullBack>,
    ) -> Result<(), PotentialError> {
        either!(&mut self.0, evaluator => {
            evaluator.evaluate_graded(structure, neighbours, grade, energy, pull_back)
        })
    }

    /// Energy of each atom after [`Grace::forward`], `[n]`, eV.
    pub fn atomic_energies(&self) -> &[f64] {
        either!(&self.0, evaluator => evaluator.atomic_energies())
    }

    /// Features z after [`Grace::forward`], `[n, D]` row-major; empty for a model without features.
    pub fn features(&self) -> &[f64] {
        either!(&self.0, evaluator => evaluator.features())
    }

    /// The derivatives for the structure of the last [`Grace::forward`], in one reverse sweep: those of the
    /// energy go to `energy`, and, with a cotangent ∂H/∂z `[n, D]`, those of H to `pull_back` (zero otherwise).
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

    /// The numbers h in which the atomic energy is linear, after [`Grace::forward`]: the linear density and the last hidden
    /// layer of the readout, `[n, D_h]` row-major with D_h = [`GraceModel::hidden_dimension`].
    pub fn hidden_layer(&mut self, out: &mut Vec<f64>) {
        either!(&mut self.0, evaluator => evaluator.hidden_layer(out));
    }

    /// The derivatives of a function H of these numbers, from its cotangent ∂H/∂h `[n, D_h]`, for the structure of the last
    /// [`Grace::forward`].
    ///
    /// # Panics
    /// If the cotangent has another length.
    pub fn pull_back_hidden_layer(&mut self, cotangent: &[f64], pull_back: &mut PullBack) {
        either!(&mut self.0, evaluator => evaluator.pull_back_hidden_layer(cotangent, pull_back));
    }

    /// Number of multiply-adds for the last structure: energies and forces, optionally with features and the
    /// pull-back of their cotangents. Counts sums of products over channels, bonds and couplings without
    /// padding, with tables of radial functions; excludes spherical harmonics, norms and activations. Benchmarks
    /// compare it with the time.
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
