//! One epoch: an update for each batch, and the validation after it.

use std::ops::ControlFlow;

use calm::build::shuffled;

use super::Trainer;
use crate::batch_gradient::{BatchGradient, BatchLoss, batch_gradient};
use crate::checkpoint::{BestWeights, TrainingState};
use crate::differences::FrameDifferences;
use crate::error::UpfitError;
use crate::evaluation::{EvaluatedFrame, first_not_finite, sum};
use crate::progress::{EpochRecord, ErrorsBySet, TrainingEvent};

impl Trainer<'_> {
    /// Trains the rest of an epoch, or up to where it is asked to stop.
    pub(super) fn train_epoch(
        &mut self,
        state: &mut TrainingState,
        on_event: &mut impl FnMut(TrainingEvent<'_>),
    ) -> Result<(), UpfitError> {
        let order = shuffled(self.settings.seed, state.epoch, self.training.len());
        let done = usize::try_from(state.batch).unwrap_or(usize::MAX);
        for batch in order.chunks(self.settings.batch_size).skip(done) {
            let loss = self.update(state, batch)?;
            on_event(TrainingEvent::Update(self.progress(state, loss)));
            if (self.stop)() {
                return Ok(());
            }
            self.save_if_due(state)?;
        }
        if self.end_epoch(state)?.is_break() {
            return Ok(());
        }
        self.save_if_due(state)?;
        if let Some(record) = state.history.last() {
            on_event(TrainingEvent::Epoch { record, seconds_left: self.seconds_left(state) });
        }
        Ok(())
    }

    /// Makes one update. Returns the loss of the batch before it.
    fn update(&mut self, state: &mut TrainingState, batch: &[usize]) -> Result<f64, UpfitError> {
        let (_, weights) = self.stage(state.epoch);
        let loss = BatchLoss { delta: self.settings.loss.delta, weights };
        let found = batch_gradient(&self.model, &self.training, batch, &mut self.sums, &loss)?;
        self.check_finite(state, batch, &found)?;
        let rate = self.rate(state.optimiser.steps());
        state.optimiser.step(&mut state.weights, &found.gradient, rate, &self.frozen);
        if let (Some(average), Some(decay)) = (&mut state.average, self.settings.average) {
            for (average, weight) in average.iter_mut().zip(&state.weights) {
                *average = decay * *average + (1.0 - decay) * weight;
            }
        }
        self.model.set_weights(&state.weights);
        state.running.merge(&found.differences);
        state.batch += 1;
        Ok(found.differences.loss(&weights))
    }

    fn check_finite(
        &self,
        state: &TrainingState,
        batch: &[usize],
        found: &BatchGradient,
    ) -> Result<(), UpfitError> {
        let (what, frames) = if !found.not_finite.is_empty() {
            ("the loss", found.not_finite.as_slice())
        } else if found.gradient.iter().any(|g| !g.is_finite()) {
            ("the gradient", batch)
        } else {
            return Ok(());
        };
        let places = frames.iter().map(|&index| self.training[index].frame.place.as_str());
        Err(UpfitError::NotFinite {
            epoch: state.epoch + 1,
            place: format!("batch {} of {}", state.batch + 1, self.batches()),
            what,
            frames: places.collect::<Vec<_>>().join(", "),
        })
    }

    /// Validates and records the epoch whose batches are all done. Breaks if it was asked to stop before.
    fn end_epoch(&mut self, state: &mut TrainingState) -> Result<ControlFlow<()>, UpfitError> {
        let (stage, weights) = self.stage(state.epoch);
        let Some(evaluated) = self.validate(state)? else { return Ok(ControlFlow::Break(())) };
        let validated = (!evaluated.is_empty()).then(|| sum(&evaluated));
        let epoch = state.epoch + 1;
        let validation = validated.map(|sums| sums.errors(&weights));
        if let Some(errors) = &validation
            && state.best.as_ref().is_none_or(|best| best.stage != stage || errors.loss < best.loss)
        {
            let weights = state.average.as_ref().unwrap_or(&state.weights).clone();
            state.best = Some(BestWeights { epoch, stage, loss: errors.loss, weights });
        }
        let errors = ErrorsBySet { training: state.running.errors(&weights), validation };
        let learning_rate = self.rate(state.optimiser.steps().saturating_sub(1));
        let updates_per_second = self.updates_per_second(state);
        state.history.push(EpochRecord { epoch, stage, learning_rate, errors, updates_per_second });
        (state.epoch, state.batch, state.running) = (epoch, 0, FrameDifferences::default());
        Ok(ControlFlow::Continue(()))
    }

    /// Evaluates the validation set, with the averaged weights if there are any. Returns `None` if it was asked to stop.
    fn validate(&mut self, state: &TrainingState) -> Result<Option<Vec<EvaluatedFrame>>, UpfitError> {
        if self.validation.is_empty() {
            return Ok(Some(Vec::new()));
        }
        if let Some(average) = &state.average {
            self.model.set_weights(average);
        }
        let evaluated = self.evaluate(&self.validation)?;
        if state.average.is_some() {
            self.model.set_weights(&state.weights);
        }
        let found = evaluated.as_ref().and_then(|evaluated| first_not_finite(&self.validation, evaluated));
        match found {
            None => Ok(evaluated),
            Some(frame) => Err(UpfitError::NotFinite {
                epoch: state.epoch + 1,
                place: "validation".to_owned(),
                what: "the loss",
                frames: frame.place.clone(),
            }),
        }
    }
}
