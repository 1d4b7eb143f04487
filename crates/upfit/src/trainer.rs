//! The state of a training, and the loop over its epochs.

mod epoch;
mod outcome;
mod start;

use std::error::Error;
use std::path::Path;
use std::time::Instant;

use potentials::grace::{Threads, TrainableGrace};

pub use self::outcome::UpfitOutcome;
use crate::batch_gradient::BatchSums;
use crate::checkpoint::{CheckpointFile, TrainingState};
use crate::data::TrainingData;
use crate::error::UpfitError;
use crate::evaluation::{EvaluatedFrame, evaluate};
use crate::frozen::frozen_weights;
use crate::identity::identity;
use crate::learning_rate::warm_up_share;
use crate::loss::LossWeights;
use crate::prepared::{NEIGHBOUR_BYTES, PreparedFrame, prepare};
use crate::progress::{TrainingEvent, UpdateProgress};
use crate::settings::UpfitSettings;
use crate::stop_request::StopRequest;

/// Trains the weights of a model. Continues from the checkpoint if there is one; the result has the same bits.
///
/// Weights are validated after each epoch, and those with the smallest loss are returned. A new stage of the loss starts a new
/// search for them. Without validation, the last weights are returned.
///
/// Asks `stop` after each update, and before each structure of an evaluation. Returns `None` if it was asked to stop; then the
/// checkpoint has all that was done, but for evaluations. There is none before the first evaluation is complete.
///
/// # Errors
/// Wrong settings or data; a loss that is not finite, which leaves the last checkpoint as it is; a checkpoint that cannot be
/// read or written, or that belongs to another training.
pub fn run(
    model: TrainableGrace,
    data: &TrainingData,
    settings: &UpfitSettings,
    checkpoint: Option<&Path>,
    stop: StopRequest<'_>,
    mut on_event: impl FnMut(TrainingEvent<'_>),
) -> Result<Option<UpfitOutcome>, UpfitError> {
    settings.check()?;
    let checkpoint = checkpoint.map(|path| CheckpointFile::new(path, identity(&model, data, settings)));
    let Some(mut trainer) = Trainer::new(model, data, settings, stop)? else { return Ok(None) };
    trainer.checkpoint = checkpoint;
    let saved = trainer.checkpoint.as_ref().map_or(Ok(None), CheckpointFile::read)?;
    let resumed = saved.as_ref().map(|state| state.epoch);
    let begun = if saved.is_some() { saved } else { trainer.begin()? };
    let Some(mut state) = begun else { return Ok(None) };
    if resumed.is_none() {
        trainer.save(&state)?;
    }
    trainer.model.set_weights(&state.weights);
    trainer.resumed_updates = state.optimiser.steps();
    let TrainingState { zero, spread, before, .. } = &state;
    on_event(TrainingEvent::Begun { resumed, zero, spread, before });
    while !stop() && !trainer.is_over(&state) {
        trainer.train_epoch(&mut state, &mut on_event)?;
    }
    let after = if stop() { None } else { trainer.errors_of_chosen(&state)? };
    // Also at the end: a process that is killed before the model is in its file has nothing to train again.
    trainer.save(&state)?;
    Ok(after.map(|after| trainer.finish(state, after)))
}

/// A training with its data.
struct Trainer<'a> {
    model: TrainableGrace,
    settings: &'a UpfitSettings,
    stop: StopRequest<'a>,
    training: Vec<PreparedFrame<'a>>,
    validation: Vec<PreparedFrame<'a>>,
    frozen: Vec<bool>,
    threads: Threads,
    sums: BatchSums,
    checkpoint: Option<CheckpointFile>,
    /// When this process began, and the number of updates of earlier ones.
    begun: Instant,
    resumed_updates: u64,
}

impl<'a> Trainer<'a> {
    fn new(
        mut model: TrainableGrace,
        data: &'a TrainingData,
        settings: &'a UpfitSettings,
        stop: StopRequest<'a>,
    ) -> Result<Option<Self>, UpfitError> {
        if data.training.is_empty() {
            return Err(UpfitError::NoFrames);
        }
        let frozen = frozen_weights(model.groups(), &settings.frozen)?;
        let mut room = NEIGHBOUR_BYTES;
        let training = prepare(model.model(), &data.training, &mut room, stop)?;
        let validation = prepare(model.model(), &data.validation, &mut room, stop)?;
        let Some((training, validation)) = training.zip(validation) else { return Ok(None) };
        let threads = settings.threads;
        let failed = |error: Box<dyn Error>| UpfitError::Threads { threads, reason: error.to_string() };
        let threads = Threads::new(threads).map_err(|error| failed(error.into()))?;
        model.set_threads(threads.clone());
        let sums = BatchSums::new(&model, threads.clone(), settings.batch_size.min(training.len()));
        Ok(Some(Self {
            model,
            settings,
            stop,
            training,
            validation,
            frozen,
            threads,
            sums,
            checkpoint: None,
            begun: Instant::now(),
            resumed_updates: 0,
        }))
    }

    /// Number of updates of one epoch.
    fn batches(&self) -> u64 {
        self.training.len().div_ceil(self.settings.batch_size) as u64
    }

    /// Index and weights of the stage of epoch number `epoch`, from 0.
    fn stage(&self, epoch: u64) -> (usize, LossWeights) {
        let stage = self.settings.loss.stage(epoch, self.settings.epochs);
        (stage, self.settings.loss.stages[stage].weights)
    }

    fn evaluate(&self, frames: &[PreparedFrame<'a>]) -> Result<Option<Vec<EvaluatedFrame>>, UpfitError> {
        evaluate(self.model.model(), frames, self.settings.loss.delta, &self.threads, self.stop)
    }

    /// Training and validation.
    fn evaluate_both(&self) -> Result<Option<[Vec<EvaluatedFrame>; 2]>, UpfitError> {
        let Some(training) = self.evaluate(&self.training)? else { return Ok(None) };
        Ok(self.evaluate(&self.validation)?.map(|validation| [training, validation]))
    }

    /// Whether all epochs are over, or the patience is used up. Only the last stage of the loss ends early.
    fn is_over(&self, state: &TrainingState) -> bool {
        let (stage, _) = self.stage(state.epoch.saturating_sub(1));
        let waited = state.best.as_ref().map_or(0, |best| state.epoch - best.epoch);
        let is_last = stage + 1 == self.settings.loss.stages.len();
        state.epoch >= self.settings.epochs
            || (is_last && self.settings.patience.is_some_and(|patience| waited >= patience))
    }

    /// Number of updates of all epochs.
    fn all_updates(&self) -> u64 {
        self.settings.epochs.saturating_mul(self.batches())
    }

    /// The learning rate of update number `update`, from 0.
    fn rate(&self, update: u64) -> f64 {
        let warm_up = warm_up_share(update, self.settings.optimiser.warm_up());
        warm_up * self.settings.learning_rate.rate(update, self.all_updates())
    }

    fn updates_per_second(&self, state: &TrainingState) -> f64 {
        let made = state.optimiser.steps() - self.resumed_updates;
        made as f64 / self.begun.elapsed().as_secs_f64().max(1e-9)
    }

    /// Expected time until the last epoch ends; `None` before this process has made an update.
    fn seconds_left(&self, state: &TrainingState) -> Option<f64> {
        let rate = Some(self.updates_per_second(state)).filter(|rate| *rate > 0.0)?;
        Some(self.all_updates().saturating_sub(state.optimiser.steps()) as f64 / rate)
    }

    fn progress(&self, state: &TrainingState, loss: f64) -> UpdateProgress {
        let (_, weights) = self.stage(state.epoch);
        UpdateProgress {
            epoch: state.epoch + 1,
            epochs: self.settings.epochs,
            updates: state.optimiser.steps(),
            all_updates: self.all_updates(),
            updates_per_second: self.updates_per_second(state),
            seconds_left: self.seconds_left(state),
            learning_rate: self.rate(state.optimiser.steps().saturating_sub(1)),
            loss,
            errors: state.running.errors(&weights),
        }
    }

    fn save(&mut self, state: &TrainingState) -> Result<(), UpfitError> {
        self.checkpoint.as_mut().map_or(Ok(()), |file| file.save(state))
    }

    fn save_if_due(&mut self, state: &TrainingState) -> Result<(), UpfitError> {
        match &mut self.checkpoint {
            Some(file) if file.is_due() => file.save(state),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests;
