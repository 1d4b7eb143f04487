//! The interface of potentials whose atoms have features that can be graded.

use std::fmt::Debug;
use std::sync::Arc;

use atoms::{Evaluation, NeighbourList, Potential, PotentialError, Species, Structure, cell};

use crate::grace::{Grace, GraceModel, GradeFunction, Instructions, PullBack, Threads};

/// A model that gives each atom an energy and features z. It has no work arrays: any number of threads can share it.
pub trait ModelWithFeatures: Debug + Send + Sync {
    /// The supported elements, in the order of the element indices.
    fn elements(&self) -> &[Species];

    /// The largest pair cutoff, Å.
    fn cutoff(&self) -> f64;

    /// Distance within which atoms of the second element affect an atom of the first (element indices), Å.
    fn pair_cutoff(&self, centre: usize, neighbour: usize) -> f64;

    /// D, the number of features of an atom.
    fn feature_dimension(&self) -> usize;

    /// The model with work arrays. Models that calculate on processor cores use these threads.
    fn evaluator(self: Arc<Self>, threads: Threads) -> Box<dyn PotentialWithFeatures>;

    /// The element index of each species, `[n]`.
    ///
    /// # Errors
    /// [`PotentialError::Species`] for an element that the model does not support.
    fn element_indices(&self, species: &[Species]) -> Result<Vec<usize>, PotentialError> {
        let index = |(atom, species): (usize, &Species)| {
            self.elements().iter().position(|known| known == species).ok_or_else(|| {
                let known: Vec<&str> = self.elements().iter().map(|known| known.symbol()).collect();
                PotentialError::Species { atom, species: *species, known: known.join(", ") }
            })
        };
        species.iter().enumerate().map(index).collect()
    }
}

/// A potential with features: [`PotentialWithFeatures::forward`] computes energies and features,
/// [`PotentialWithFeatures::backward`] the derivatives for the same structure.
pub trait PotentialWithFeatures: Potential + Sync {
    /// The model.
    fn model(&self) -> &dyn ModelWithFeatures;

    /// Computes atomic energies and features of `structure`. `neighbours` must be up to date for it.
    ///
    /// # Errors
    /// An unsupported element, a neighbour list that is too short, or a program that does not answer.
    fn forward(&mut self, structure: &Structure, neighbours: &NeighbourList) -> Result<(), PotentialError>;

    /// Energy of each atom after [`PotentialWithFeatures::forward`], `[n]`, eV.
    fn atomic_energies(&self) -> &[f64];

    /// Features z after [`PotentialWithFeatures::forward`], `[n, D]` row-major.
    fn features(&self) -> &[f64];

    /// The derivatives for the structure of the last [`PotentialWithFeatures::forward`]: those of the energy go to `energy`, and, with a
    /// cotangent ∂H/∂z `[n, D]`, those of H to `pull_back` (zero otherwise).
    ///
    /// # Errors
    /// A program that does not answer.
    fn backward(
        &mut self,
        cotangent: Option<&[f64]>,
        energy: &mut Evaluation,
        pull_back: &mut PullBack,
    ) -> Result<(), PotentialError>;

    /// Energies, features and the derivatives of both (without `pull_back` those of the energy only), for a cotangent ∂H/∂z of each
    /// atom that depends on its own features only, which `grade` gives.
    ///
    /// # Errors
    /// As [`PotentialWithFeatures::forward`].
    fn evaluate_graded(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        grade: &GradeFunction,
        energy: &mut Evaluation,
        pull_back: Option<&mut PullBack>,
    ) -> Result<(), PotentialError>;

    /// Energies, features, and as forces and virial −∂/∂r and −∂/∂ε of Σ E + H together, for a cotangent ∂H/∂z as in
    /// [`PotentialWithFeatures::evaluate_graded`]. What it saves is up to the potential.
    ///
    /// # Errors
    /// As [`PotentialWithFeatures::forward`].
    fn evaluate_combined(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        grade: &GradeFunction,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        let mut pull_back = PullBack::default();
        self.evaluate_graded(structure, neighbours, grade, out, Some(&mut pull_back))?;
        for (force, gradient) in out.forces.iter_mut().zip(&pull_back.gradient) {
            *force = cell::sub(*force, *gradient);
        }
        let both = out.virial.as_flattened_mut().iter_mut().zip(pull_back.virial.as_flattened());
        both.for_each(|(virial, of_features)| *virial -= of_features);
        Ok(())
    }
}

impl ModelWithFeatures for GraceModel {
    fn elements(&self) -> &[Species] {
        self.elements()
    }

    fn cutoff(&self) -> f64 {
        self.cutoff()
    }

    fn pair_cutoff(&self, centre: usize, neighbour: usize) -> f64 {
        self.pair_cutoff(centre, neighbour)
    }

    fn feature_dimension(&self) -> usize {
        self.feature_dimension()
    }

    fn evaluator(self: Arc<Self>, threads: Threads) -> Box<dyn PotentialWithFeatures> {
        Box::new(Grace::with(self, Instructions::best(), threads))
    }
}

impl PotentialWithFeatures for Grace {
    fn model(&self) -> &dyn ModelWithFeatures {
        &**self.model()
    }

    fn forward(&mut self, structure: &Structure, neighbours: &NeighbourList) -> Result<(), PotentialError> {
        self.forward(structure, neighbours)
    }

    fn atomic_energies(&self) -> &[f64] {
        self.atomic_energies()
    }

    fn features(&self) -> &[f64] {
        self.features()
    }

    fn backward(
        &mut self,
        cotangent: Option<&[f64]>,
        energy: &mut Evaluation,
        pull_back: &mut PullBack,
    ) -> Result<(), PotentialError> {
        self.backward(cotangent, energy, pull_back);
        Ok(())
    }

    fn evaluate_graded(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        grade: &GradeFunction,
        energy: &mut Evaluation,
        pull_back: Option<&mut PullBack>,
    ) -> Result<(), PotentialError> {
        self.evaluate_graded(structure, neighbours, grade, energy, pull_back)
    }
}
