//! The start of a training: the zero of the energies, and the errors before the first update.

use analysis::LabelledEnergy;
use atoms::composition;

use super::Trainer;
use crate::checkpoint::{BestWeights, TrainingState};
use crate::differences::FrameDifferences;
use crate::energy_deviations::EnergyDeviations;
use crate::energy_zero::EnergyZero;
use crate::error::UpfitError;
use crate::evaluation::{EvaluatedFrame, first_not_finite, sum};
use crate::frame_fault::{FrameFault, MAX_ENERGY_DIFFERENCE};
use crate::prepared::PreparedFrame;
use crate::progress::ErrorsBySet;

impl<'a> Trainer<'a> {
    /// Moves the zero of the energies and validates the weights with which the training begins. Returns `None` if it was asked to
    /// stop.
    pub(super) fn begin(&mut self) -> Result<Option<TrainingState>, UpfitError> {
        let Some(mut evaluated) = self.evaluate_both()? else { return Ok(None) };
        for (frames, evaluated) in [&self.training, &self.validation].into_iter().zip(&evaluated) {
            if let Some(frame) = first_not_finite(frames, evaluated) {
                return Err(frame.wrong(FrameFault::ModelNotFinite));
            }
        }
        let (zero, spread) = self.find_zero(&evaluated)?;
        let mut weights = self.model.weights().to_vec();
        zero.apply(&mut weights, self.model.groups(), self.model.model().elements())?;
        if !zero.shifts.is_empty() {
            self.model.set_weights(&weights);
            let Some(again) = self.evaluate_both()? else { return Ok(None) };
            evaluated = again;
        }
        let [training, validation] = evaluated.map(|evaluated| sum(&evaluated));
        let validation = (!self.validation.is_empty()).then_some(validation);
        let state = self.first_state(weights, &training, validation);
        Ok(Some(TrainingState { zero, spread, ..state }))
    }

    /// The state before the first update, but for the zero of the energies.
    fn first_state(
        &self,
        weights: Vec<f64>,
        training: &FrameDifferences,
        validation: Option<FrameDifferences>,
    ) -> TrainingState {
        let ((stage, of_first), (_, of_last)) = (self.stage(0), self.stage(self.settings.epochs));
        let best = validation.map(|sums| BestWeights {
            epoch: 0,
            stage,
            loss: sums.loss(&of_first),
            weights: weights.clone(),
        });
        let validation = validation.map(|sums| sums.errors(&of_last));
        TrainingState {
            epoch: 0,
            batch: 0,
            average: self.settings.average.map(|_| weights.clone()),
            optimiser: self.settings.optimiser.start(self.model.groups()),
            running: FrameDifferences::default(),
            best,
            weights,
            history: Vec::new(),
            zero: EnergyZero::default(),
            spread: EnergyDeviations::default(),
            before: ErrorsBySet { training: training.errors(&of_last), validation },
        }
    }

    /// The shifts that move the model's zero to that of the training set, and how the energies of all structures differ after them.
    /// Refuses energies that remain far away.
    fn find_zero(
        &self,
        [training, validation]: &[Vec<EvaluatedFrame>; 2],
    ) -> Result<(EnergyZero, EnergyDeviations), UpfitError> {
        let labelled = |(prepared, evaluated): (&PreparedFrame<'a>, &EvaluatedFrame)| LabelledEnergy {
            composition: composition(&prepared.frame.structure.species),
            model: evaluated.energy,
            label: prepared.frame.energy,
        };
        let energies: Vec<_> = self.training.iter().zip(training).map(labelled).collect();
        let places: Vec<_> = self.training.iter().map(|prepared| prepared.frame.place.as_str()).collect();
        let zero = EnergyZero::find(&energies, &places)?;
        let validated = self.validation.iter().zip(validation).map(labelled);
        let frames = self.training.iter().chain(&self.validation);
        let mut differences = Vec::new();
        for (prepared, energy) in frames.zip(energies.into_iter().chain(validated)) {
            let shift = zero.of(&energy.composition);
            let difference = (energy.label - energy.model - shift) / prepared.frame.structure.len() as f64;
            if difference.abs() > MAX_ENERGY_DIFFERENCE {
                return Err(prepared.frame.wrong(FrameFault::FarEnergy { difference }));
            }
            differences.push((prepared.frame.place.as_str(), difference));
        }
        Ok((zero, EnergyDeviations::new(&differences)))
    }
}
