//! Sums over the differences between model and labels.

use atoms::Evaluation;
use serde::{Deserialize, Serialize};

use crate::data::LabelledFrame;
use crate::loss::{LossWeights, STRESS_COMPONENTS, huber};
use crate::progress::SetErrors;

/// Sums over differences of one quantity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct DifferenceSums {
    number: f64,
    absolute: f64,
    square: f64,
    /// Σ weight · huber
    loss: f64,
}

/// Differences of energies per atom (eV), force components (eV/Å) and stress components (eV/Å³).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FrameDifferences {
    energy: DifferenceSums,
    forces: DifferenceSums,
    stress: DifferenceSums,
}

impl DifferenceSums {
    fn add(&mut self, difference: f64, weight: f64, delta: f64) {
        self.number += 1.0;
        self.absolute += difference.abs();
        self.square += difference * difference;
        self.loss += weight * huber(difference, delta);
    }

    fn merge(&mut self, other: &Self) {
        self.number += other.number;
        self.absolute += other.absolute;
        self.square += other.square;
        self.loss += other.loss;
    }

    fn mean(&self, sum: f64) -> f64 {
        sum / self.number.max(1.0)
    }

    fn mean_absolute(&self) -> Option<f64> {
        (self.number > 0.0).then(|| self.mean(self.absolute))
    }

    fn root_mean_square(&self) -> Option<f64> {
        (self.number > 0.0).then(|| self.mean(self.square).sqrt())
    }
}

impl FrameDifferences {
    /// Those of one structure, with the δ of the loss.
    ///
    /// # Panics
    /// If the evaluation is of another number of atoms.
    pub fn new(frame: &LabelledFrame, evaluation: &Evaluation, delta: f64) -> Self {
        assert_eq!(evaluation.forces.len(), frame.forces.len(), "forces of each atom");
        let mut found = Self::default();
        let atoms = frame.structure.len() as f64;
        found.energy.add((evaluation.energy() - frame.energy) / atoms, frame.weight, delta);
        let components = evaluation.forces.as_flattened().iter().zip(frame.forces.as_flattened());
        components.for_each(|(model, label)| found.forces.add(model - label, frame.weight, delta));
        if let (Some(label), Some(model)) = (frame.stress, evaluation.stress(&frame.structure)) {
            for (i, k) in STRESS_COMPONENTS {
                found.stress.add(model[i][k] - label[i][k], frame.weight, delta);
            }
        }
        found
    }

    /// Adds the differences of other structures.
    pub fn merge(&mut self, other: &Self) {
        self.energy.merge(&other.energy);
        self.forces.merge(&other.forces);
        self.stress.merge(&other.stress);
    }

    /// Whether all sums are finite.
    pub fn is_finite(&self) -> bool {
        [self.energy, self.forces, self.stress]
            .iter()
            .all(|sums| sums.square.is_finite() && sums.loss.is_finite())
    }

    /// The loss of these structures as one batch.
    pub fn loss(&self, weights: &LossWeights) -> f64 {
        let mean = |sums: &DifferenceSums| sums.mean(sums.loss);
        weights.energy * mean(&self.energy)
            + weights.forces * mean(&self.forces)
            + weights.stress * mean(&self.stress)
    }

    /// Errors and loss.
    pub fn errors(&self, weights: &LossWeights) -> SetErrors {
        SetErrors {
            structures: self.energy.number as u64,
            loss: self.loss(weights),
            energy_mae: self.energy.mean_absolute().unwrap_or_default(),
            energy_rmse: self.energy.root_mean_square().unwrap_or_default(),
            force_mae: self.forces.mean_absolute().unwrap_or_default(),
            force_rmse: self.forces.root_mean_square().unwrap_or_default(),
            stress_mae: self.stress.mean_absolute(),
            stress_rmse: self.stress.root_mean_square(),
        }
    }
}
