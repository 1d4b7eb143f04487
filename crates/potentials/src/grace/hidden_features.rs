//! The hidden layer of the readout as the features of a model.

use std::sync::Arc;

use atoms::{Evaluation, NeighbourList, Potential, PotentialError, Species, Structure};

use super::{Grace, GraceModel, GradeFunction, Instructions, PullBack, Threads};
use crate::features::{ModelWithFeatures, PotentialWithFeatures};

/// A model whose features are the numbers in which its atomic energies are linear ([`Grace::hidden_layer`]).
#[derive(Clone, Debug)]
pub struct HiddenLayerModel(pub Arc<GraceModel>);

/// It with work arrays.
#[derive(Debug)]
struct HiddenLayerPotential {
    model: Arc<HiddenLayerModel>,
    grace: Grace,
    hidden: Vec<f64>,
    /// Derivatives of the projected features, which come with those of the energy.
    unused: PullBack,
}

impl ModelWithFeatures for HiddenLayerModel {
    fn elements(&self) -> &[Species] {
        self.0.elements()
    }

    fn cutoff(&self) -> f64 {
        self.0.cutoff()
    }

    fn pair_cutoff(&self, centre: usize, neighbour: usize) -> f64 {
        self.0.pair_cutoff(centre, neighbour)
    }

    fn feature_dimension(&self) -> usize {
        self.0.hidden_dimension()
    }

    fn evaluator(self: Arc<Self>, threads: Threads) -> Box<dyn PotentialWithFeatures> {
        let grace = Grace::with(Arc::clone(&self.0), Instructions::best(), threads);
        Box::new(HiddenLayerPotential { model: self, grace, hidden: Vec::new(), unused: PullBack::default() })
    }
}

impl Potential for HiddenLayerPotential {
    fn cutoff(&self) -> f64 {
        self.grace.cutoff()
    }

    fn species(&self) -> &[Species] {
        self.grace.species()
    }

    fn evaluate(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        self.grace.evaluate(structure, neighbours, out)
    }
}

impl PotentialWithFeatures for HiddenLayerPotential {
    fn model(&self) -> &dyn ModelWithFeatures {
        &*self.model
    }

    fn forward(&mut self, structure: &Structure, neighbours: &NeighbourList) -> Result<(), PotentialError> {
        self.grace.forward(structure, neighbours)?;
        self.grace.hidden_layer(&mut self.hidden);
        Ok(())
    }

    fn atomic_energies(&self) -> &[f64] {
        self.grace.atomic_energies()
    }

    fn features(&self) -> &[f64] {
        &self.hidden
    }

    fn backward(
        &mut self,
        cotangent: Option<&[f64]>,
        energy: &mut Evaluation,
        pull_back: &mut PullBack,
    ) -> Result<(), PotentialError> {
        self.grace.backward(None, energy, &mut self.unused);
        match cotangent {
            Some(cotangent) => self.grace.pull_back_hidden_layer(cotangent, pull_back),
            None => pull_back.reset(energy.forces.len()),
        }
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
        self.forward(structure, neighbours)?;
        let atoms: Vec<u32> = (0..structure.len() as u32).collect();
        let mut cotangent = vec![0.0; if pull_back.is_some() { self.hidden.len() } else { 0 }];
        grade(&atoms, &self.hidden, &mut cotangent);
        self.grace.backward(None, energy, &mut self.unused);
        if let Some(pull_back) = pull_back {
            self.grace.pull_back_hidden_layer(&cotangent, pull_back);
        }
        Ok(())
    }
}
