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
    /// Takes the best weights, or the last ones without validation, and measures their errors. Returns `None` if it was asked to stop.
    ///
    /// # Errors
    /// Errors that are not finite: nothing has checked the last update without validation.
    pub(super) fn errors_of_chosen(
        &mut self,
        state: &TrainingState,
    ) -> Result<Option<ErrorsBySet>, UpfitError> {
        let (epoch, weights) = chosen(state);
        self.model.set_weights(weights);
        let Some(evaluated) = self.evaluate_both()? else { return Ok(None) };
        for (frames, evaluated) in [&self.training, &self.validation].into_iter().zip(&evaluated) {
            if let Some(frame) = first_not_finite(frames, evaluated) {
                return Err(UpfitError::NotFinite {
                    epoch,
                    place: "the last update".to_owned(),
                    what: "the loss",
                    frames: frame.place.clone(),
                });
            }
        }
        let (_, of_last) = self.stage(self.settings.epochs);
        let [training, validation] = evaluated.map(|evaluated| sum(&evaluated).errors(&of_last));
        let validation = (!self.validation.is_empty()).then_some(validation);
        Ok(Some(ErrorsBySet { training, validation }))
    }

    /// The outcome, with the errors of the chosen weights, which the model has.
    pub(super) fn finish(self, state: TrainingState, after: ErrorsBySet) -> UpfitOutcome {
        let (epoch, _) = chosen(&state);
        UpfitOutcome {
            model: self.model,
            epoch,
            updates: state.optimiser.steps(),
            ended_early: state.epoch < self.settings.epochs,
            zero: state.zero,
            spread: state.spread,
            before: state.before,
            after,
            history: state.history,
        }
    }
}

/// The best weights, or the last ones without validation, and the number of their epochs.
fn chosen(state: &TrainingState) -> (u64, &[f64]) {
    match &state.best {
        Some(best) => (best.epoch, best.weights.as_slice()),
        None => (state.epoch, state.average.as_ref().unwrap_or(&state.weights).as_slice()),
    }
}
