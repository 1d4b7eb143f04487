//! The loop of a training.

use std::error::Error;
use std::ops::ControlFlow;
use std::path::Path;
use std::time::Instant;

use analysis::LabelledEnergy;
use atoms::composition;
use calm::build::shuffled;
use potentials::grace::{Threads, TrainableGrace};

use crate::adam::AdamState;
use crate::checkpoint::{BestWeights, CheckpointFile, TrainingState};
use crate::data::{FrameFault, MAX_ENERGY_DIFFERENCE, TrainingData, data_hash};
use crate::differences::FrameDifferences;
use crate::energy_zero::EnergyZero;
use crate::epoch::{BatchGradient, BatchLoss, BatchSums, batch_gradient};
use crate::error::UpfitError;
use crate::evaluation::{EvaluatedFrame, evaluate, first_not_finite, sum};
use crate::frozen::frozen_weights;
use crate::loss::LossWeights;
use crate::prepared::{NEIGHBOUR_BYTES, PreparedFrame, prepare};
use crate::progress::{EpochRecord, ErrorsBySet, TrainingEvent, UpdateProgress};
use crate::settings::UpfitSettings;

/// A finished training.
pub struct UpfitOutcome {
    /// The model with the weights that were chosen: the best ones of validation, or the last ones.
    pub model: TrainableGrace,
    /// How the zero of the energies was moved.
    pub zero: EnergyZero,
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

/// Trains the weights of a model. Continues from the checkpoint if there is one; the result has the same bits. `on_event`
/// asks to stop by breaking, after which the checkpoint has all that was done.
///
/// Weights are validated after each epoch, and those with the smallest loss are returned. A new stage of the loss starts a new
/// search for them. Without validation, the last weights are returned.
///
/// Returns `None` if it was asked to stop.
///
/// # Errors
/// Wrong settings or data; a loss that is not finite, which leaves the last checkpoint as it is; a checkpoint that cannot be
/// read or written, or that belongs to another training.
pub fn run(
    model: TrainableGrace,
    data: &TrainingData,
    settings: &UpfitSettings,
    checkpoint: Option<&Path>,
    mut on_event: impl FnMut(TrainingEvent<'_>) -> ControlFlow<()>,
) -> Result<Option<UpfitOutcome>, UpfitError> {
    settings.check()?;
    let identity = identity(&model, data, settings);
    let mut trainer = Trainer::new(model, data, settings)?;
    trainer.checkpoint = checkpoint.map(|path| CheckpointFile::new(path, identity));
    let saved = trainer.checkpoint.as_ref().map_or(Ok(None), CheckpointFile::read)?;
    let resumed = saved.as_ref().map(|state| state.epoch);
    let mut state = match saved {
        Some(state) => state,
        None => {
            let state = trainer.begin()?;
            trainer.save(&state)?;
            state
        }
    };
    trainer.model.set_weights(&state.weights);
    trainer.resumed_updates = state.adam.steps();
    let begun = TrainingEvent::Begun { resumed, zero: &state.zero, before: &state.before };
    let mut flow = on_event(begun);
    while flow.is_continue() && !trainer.is_over(&state) {
        flow = trainer.train_epoch(&mut state, &mut on_event)?;
    }
    if flow.is_break() {
        trainer.save(&state)?;
        return Ok(None);
    }
    trainer.finish(state).map(Some)
}

/// Names and values of what determines the result.
fn identity(model: &TrainableGrace, data: &TrainingData, settings: &UpfitSettings) -> Vec<(String, String)> {
    let mut hasher = blake3::Hasher::new();
    for group in model.groups() {
        hasher.update(format!("{} {:?}\n", group.name, group.shape).as_bytes());
    }
    for weight in model.weights() {
        hasher.update(&weight.to_le_bytes());
    }
    let mut entries = vec![
        ("model (BLAKE3 of its weights)".to_owned(), hasher.finalize().to_string()),
        ("training set (BLAKE3)".to_owned(), data_hash(&data.training)),
        ("validation set (BLAKE3)".to_owned(), data_hash(&data.validation)),
    ];
    entries.extend(settings.entries());
    entries
}

/// A training with its data.
struct Trainer<'a> {
    model: TrainableGrace,
    settings: &'a UpfitSettings,
    training: Vec<PreparedFrame<'a>>,
    validation: Vec<PreparedFrame<'a>>,
    frozen: Vec<bool>,
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
    ) -> Result<Self, UpfitError> {
        if data.training.is_empty() {
            return Err(UpfitError::NoFrames);
        }
        let frozen = frozen_weights(model.groups(), &settings.frozen)?;
        let mut room = NEIGHBOUR_BYTES;
        let training = prepare(model.model(), &data.training, &mut room)?;
        let validation = prepare(model.model(), &data.validation, &mut room)?;
        let threads = settings.threads;
        let failed = |error: Box<dyn Error>| UpfitError::Threads { threads, reason: error.to_string() };
        model.set_threads(Threads::new(threads).map_err(|error| failed(error.into()))?);
        let begun = Instant::now();
        let sums = BatchSums::new(&model, threads.min(settings.batch_size).min(training.len()));
        Ok(Self {
            model,
            settings,
            training,
            validation,
            frozen,
            sums,
            checkpoint: None,
            begun,
            resumed_updates: 0,
        })
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

    fn evaluate(&self, frames: &[PreparedFrame<'a>]) -> Result<Vec<EvaluatedFrame>, UpfitError> {
        evaluate(self.model.model(), frames, self.settings.loss.delta, self.settings.threads)
    }

    /// Of a set without structures, `None`.
    fn evaluate_some(&self, frames: &[PreparedFrame<'a>]) -> Result<Option<Vec<EvaluatedFrame>>, UpfitError> {
        (!frames.is_empty()).then(|| self.evaluate(frames)).transpose()
    }

    /// Moves the zero of the energies and validates the weights with which the training begins.
    fn begin(&mut self) -> Result<TrainingState, UpfitError> {
        let mut training = self.evaluate(&self.training)?;
        let mut validation = self.evaluate_some(&self.validation)?;
        let none = Vec::new();
        let validated = validation.as_ref().unwrap_or(&none);
        for (frames, evaluated) in [(&self.training, &training), (&self.validation, validated)] {
            if let Some(frame) = first_not_finite(frames, evaluated) {
                return Err(frame.wrong(FrameFault::ModelNotFinite));
            }
        }
        let zero = self.find_zero(&training, validated)?;
        let mut weights = self.model.weights().to_vec();
        zero.apply(&mut weights, self.model.groups(), self.model.model().elements())?;
        if !zero.shifts.is_empty() {
            self.model.set_weights(&weights);
            training = self.evaluate(&self.training)?;
            validation = self.evaluate_some(&self.validation)?;
        }
        Ok(self.first_state(weights, zero, &sum(&training), validation.map(|found| sum(&found))))
    }

    fn first_state(
        &self,
        weights: Vec<f64>,
        zero: EnergyZero,
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
            adam: AdamState::new(weights.len()),
            running: FrameDifferences::default(),
            best,
            weights,
            history: Vec::new(),
            zero,
            before: ErrorsBySet { training: training.errors(&of_last), validation },
        }
    }

    /// The shifts that move the model's zero to that of the training set. Refuses energies that remain far away.
    fn find_zero(
        &self,
        training: &[EvaluatedFrame],
        validation: &[EvaluatedFrame],
    ) -> Result<EnergyZero, UpfitError> {
        let labelled = |(prepared, evaluated): (&PreparedFrame<'a>, &EvaluatedFrame)| LabelledEnergy {
            composition: composition(&prepared.frame.structure.species),
            model: evaluated.energy,
            label: prepared.frame.energy,
        };
        let energies: Vec<_> = self.training.iter().zip(training).map(labelled).collect();
        let zero = EnergyZero::find(&energies)?;
        let validated = self.validation.iter().zip(validation).map(labelled);
        let frames = self.training.iter().chain(&self.validation);
        for (prepared, energy) in frames.zip(energies.into_iter().chain(validated)) {
            let shift = zero.of(&energy.composition);
            let difference = (energy.label - energy.model - shift) / prepared.frame.structure.len() as f64;
            if difference.abs() > MAX_ENERGY_DIFFERENCE {
                return Err(prepared.frame.wrong(FrameFault::FarEnergy { difference }));
            }
        }
        Ok(zero)
    }

    /// Whether all epochs are over, or the patience is used up. Only the last stage of the loss ends early.
    fn is_over(&self, state: &TrainingState) -> bool {
        let (stage, _) = self.stage(state.epoch.saturating_sub(1));
        let waited = state.best.as_ref().map_or(0, |best| state.epoch - best.epoch);
        let is_last = stage + 1 == self.settings.loss.stages.len();
        state.epoch >= self.settings.epochs
            || (is_last && self.settings.patience.is_some_and(|patience| waited >= patience))
    }

    /// Trains the rest of an epoch.
    fn train_epoch(
        &mut self,
        state: &mut TrainingState,
        on_event: &mut impl FnMut(TrainingEvent<'_>) -> ControlFlow<()>,
    ) -> Result<ControlFlow<()>, UpfitError> {
        let order = shuffled(self.settings.seed, state.epoch, self.training.len());
        let done = usize::try_from(state.batch).unwrap_or(usize::MAX);
        for batch in order.chunks(self.settings.batch_size).skip(done) {
            let loss = self.update(state, batch)?;
            if on_event(TrainingEvent::Update(self.progress(state, loss))).is_break() {
                return Ok(ControlFlow::Break(()));
            }
            self.save_if_due(state)?;
        }
        self.end_epoch(state)?;
        self.save_if_due(state)?;
        Ok(state
            .history
            .last()
            .map_or(ControlFlow::Continue(()), |record| on_event(TrainingEvent::Epoch(record))))
    }

    /// Makes one update. Returns the loss of the batch before it.
    fn update(&mut self, state: &mut TrainingState, batch: &[usize]) -> Result<f64, UpfitError> {
        let (_, weights) = self.stage(state.epoch);
        let loss = BatchLoss { delta: self.settings.loss.delta, weights };
        let found = batch_gradient(&self.model, &self.training, batch, &mut self.sums, &loss)?;
        self.check_finite(state, batch, &found)?;
        let rate = self.rate(state.adam.steps());
        state.adam.step(&mut state.weights, &found.gradient, rate, &self.frozen);
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

    /// Number of updates of all epochs.
    fn all_updates(&self) -> u64 {
        self.settings.epochs.saturating_mul(self.batches())
    }

    /// The learning rate of update number `update`, from 0.
    fn rate(&self, update: u64) -> f64 {
        self.settings.learning_rate.rate(update, self.all_updates())
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

    /// Validates and records the epoch whose batches are all done.
    fn end_epoch(&mut self, state: &mut TrainingState) -> Result<(), UpfitError> {
        let (stage, weights) = self.stage(state.epoch);
        let validated = self.validate(state)?;
        let epoch = state.epoch + 1;
        let validation = validated.map(|sums| sums.errors(&weights));
        if let Some(errors) = &validation
            && state.best.as_ref().is_none_or(|best| best.stage != stage || errors.loss < best.loss)
        {
            let weights = state.average.as_ref().unwrap_or(&state.weights).clone();
            state.best = Some(BestWeights { epoch, stage, loss: errors.loss, weights });
        }
        let errors = ErrorsBySet { training: state.running.errors(&weights), validation };
        let learning_rate = self.rate(state.adam.steps().saturating_sub(1));
        let updates_per_second = self.updates_per_second(state);
        state.history.push(EpochRecord { epoch, stage, learning_rate, errors, updates_per_second });
        (state.epoch, state.batch, state.running) = (epoch, 0, FrameDifferences::default());
        Ok(())
    }

    /// Differences of the validation set, with the averaged weights if there are any.
    fn validate(&mut self, state: &TrainingState) -> Result<Option<FrameDifferences>, UpfitError> {
        if self.validation.is_empty() {
            return Ok(None);
        }
        if let Some(average) = &state.average {
            self.model.set_weights(average);
        }
        let evaluated = self.evaluate(&self.validation)?;
        if state.average.is_some() {
            self.model.set_weights(&state.weights);
        }
        if let Some(frame) = first_not_finite(&self.validation, &evaluated) {
            return Err(UpfitError::NotFinite {
                epoch: state.epoch + 1,
                place: "validation".to_owned(),
                what: "the loss",
                frames: frame.place.clone(),
            });
        }
        Ok(Some(sum(&evaluated)))
    }

    /// Takes the best weights, or the last ones without validation, and measures their errors.
    ///
    /// # Errors
    /// Errors that are not finite: nothing has checked the last update without validation.
    fn finish(mut self, state: TrainingState) -> Result<UpfitOutcome, UpfitError> {
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
            before: state.before,
            after,
            history: state.history,
            epoch,
            updates,
            ended_early,
        })
    }

    fn updates_per_second(&self, state: &TrainingState) -> f64 {
        let made = state.adam.steps() - self.resumed_updates;
        made as f64 / self.begun.elapsed().as_secs_f64().max(1e-9)
    }

    fn progress(&self, state: &TrainingState, loss: f64) -> UpdateProgress {
        let (updates, all_updates) = (state.adam.steps(), self.all_updates());
        let updates_per_second = self.updates_per_second(state);
        UpdateProgress {
            epoch: state.epoch + 1,
            epochs: self.settings.epochs,
            updates,
            all_updates,
            updates_per_second,
            seconds_left: all_updates.saturating_sub(updates) as f64 / updates_per_second.max(1e-12),
            loss,
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
