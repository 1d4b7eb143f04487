//! The end of a training: the weights that were chosen, and their errors.

use potentials::grace::TrainableGrace;

use super::Trainer;
use crate::checkpoint::TrainingState;
use crate::energy_deviations::EnergyDeviations;
use crate::energy_zero::EnergyZero;
use crate::error::UpfitError;
use crate::evaluation::{first_not_finite, sum};
use crate::progress::{EpochRecord, ErrorsBySet};

/// A finished training.
pub struct UpfitOutcome {
    /// The model with the weights that were chosen: the best ones of validation, or the last ones.
    pub model: TrainableGrace,
    /// How the zero of the energies was moved.
    pub zero: EnergyZero,
    /// How the labels' energies differ from those of the model before the first update.
    pub spread: EnergyDeviations,
    /// Errors before the first update, with the loss of the last stage.
    pub before: ErrorsBySet,
    /// Errors of the model, with the same loss.
    pub after: ErrorsBySet,
    /// The epochs.
    pub history: Vec<EpochRecord>,
    /// The epoch whose weights were chosen; 0: those before the first update.
    pub epoch: u64,
    /// Updates made.
    pub updates: u64,
    /// Whether the patience ended the training.
    pub ended_early: bool,
}

impl Trainer<'_> {
    /// Takes the best weights, or the last ones without validation, and measures their errors.
    ///
    /// # Errors
    /// Errors that are not finite: nothing has checked the last update without validation.
    pub(super) fn finish(mut self, state: TrainingState) -> Result<UpfitOutcome, UpfitError> {
        let updates = state.adam.steps();
        let ended_early = state.epoch < self.settings.epochs;
        let (epoch, weights) = match state.best {
            Some(best) => (best.epoch, best.weights),
            None => (state.epoch, state.average.unwrap_or(state.weights)),
        };
        self.model.set_weights(&weights);
        let (_, of_last) = self.stage(self.settings.epochs);
        let training = self.evaluate(&self.training)?;
        let validation = self.evaluate(&self.validation)?;
        for (frames, evaluated) in [(&self.training, &training), (&self.validation, &validation)] {
            if let Some(frame) = first_not_finite(frames, evaluated) {
                return Err(UpfitError::NotFinite {
                    epoch,
                    place: "the last update".to_owned(),
                    what: "the loss",
                    frames: frame.place.clone(),
                });
            }
        }
        let validated = !validation.is_empty();
        let after = ErrorsBySet {
            training: sum(&training).errors(&of_last),
            validation: validated.then(|| sum(&validation).errors(&of_last)),
        };
        Ok(UpfitOutcome {
            model: self.model,
            zero: state.zero,
            spread: state.spread,
            before: state.before,
            after,
            history: state.history,
            epoch,
            updates,
            ended_early,
        })
    }
}
