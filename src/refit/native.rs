//! Training by calmwalk itself.

use std::path::{Path, PathBuf};

use potentials::grace::TrainableGrace;
use tokio_util::sync::CancellationToken;
use upfit::{CosineDecay, LossSettings, TrainingEvent, UpfitSettings};

use super::failure::RefitFailure;
use super::settings::RefitSettings;
use crate::config::{NativeRefit, RefitLoss};
use crate::exit_status::CommandError;
use crate::labelled_frames::{DataFile, read_frames};
use crate::process_config::HashedFile;
use crate::structure_files::{StructureFiles, StructureReadingArgs};
use crate::upfit_run::{self, UpfitRun};

/// A training with the labels of a campaign, or with others in their place.
pub struct NativeTraining<'a> {
    /// The model to begin with, and what it is called in the note of the new one.
    pub begin: (&'a HashedFile, String),
    /// Labels besides the replay data.
    pub labels: &'a Path,
    /// File for the new model.
    pub output: PathBuf,
}

/// What a training was.
#[derive(Clone, Debug)]
pub struct TrainingSummary {
    /// Structures trained on, those of the replay data among them.
    pub structures: u64,
    /// Structures for validation.
    pub validation: u64,
    /// Epochs.
    pub epochs: u64,
}

impl NativeTraining<'_> {
    /// Trains, or continues. `None` after a cancellation of `stop`.
    ///
    /// # Errors
    /// Refused: a model that cannot be trained, labels that nothing can be trained on, a loss that is not finite. Failed: a full disk.
    pub fn run(
        self,
        (settings, native): (&RefitSettings, &NativeRefit),
        rng_seed: u64,
        stop: &CancellationToken,
        report: &dyn Fn(String),
    ) -> Result<Option<TrainingSummary>, RefitFailure> {
        let (begin, name) = self.begin;
        let model = TrainableGrace::load(&begin.path).map_err(RefitFailure::refused)?;
        let files = files(settings, self.labels)?;
        let read = read_frames(&files, stop).map_err(RefitFailure::of_input)?;
        let Some((frames, sources)) = read else { return Ok(None) };
        let data = upfit::split(frames, native.validation_share, rng_seed);
        let data = data.map_err(RefitFailure::of_training)?;
        let upfit_settings = upfit_settings(native, rng_seed, settings.threads());
        // Without directories, so that the model has the same bytes wherever the campaign is.
        let sources: Vec<_> = sources.into_iter().map(DataFile::without_directory).collect();
        let note = upfit_run::note((&name, &model), &data, &sources, &upfit_settings);
        let [structures, validation] = [&data.training, &data.validation].map(|set| set.len() as u64);
        let checkpoint = self.output.with_extension("npz.upfit");
        let epochs = upfit_settings.epochs;
        let run = UpfitRun { model, data, note, settings: upfit_settings, output: self.output, checkpoint };
        let outcome = run.run(
            stop,
            |event| {
                if let TrainingEvent::Epoch { record, .. } = event {
                    let errors = record.errors.validation.as_ref().unwrap_or(&record.errors.training);
                    report(format!(
                        "epoch {} of {epochs}, force MAE {:.1} meV/Å, energy MAE {:.2} meV/atom",
                        record.epoch,
                        1e3 * errors.force_mae,
                        1e3 * errors.energy_mae
                    ));
                }
            },
            |_| Ok(()),
            RefitFailure::of_training,
        )?;
        Ok(outcome.map(|outcome| TrainingSummary {
            structures,
            validation,
            epochs: outcome.history.len() as u64,
        }))
    }
}

/// The replay data with their weight, and these labels.
pub fn files(settings: &RefitSettings, labels: &Path) -> Result<StructureFiles, CommandError> {
    let replay: Vec<PathBuf> = settings.replay.iter().map(|file| file.path.clone()).collect();
    let all = [replay.as_slice(), &[labels.to_owned()]].concat();
    let mut files = StructureReadingArgs::default().files(&all)?;
    let weights: Vec<_> = replay.into_iter().map(|path| (path, settings.replay_weight)).collect();
    files.set_weights(&weights)?;
    Ok(files)
}

fn upfit_settings(native: &NativeRefit, seed: u64, threads: usize) -> UpfitSettings {
    let mut loss = match native.loss {
        RefitLoss::Demo => LossSettings::demo(),
        RefitLoss::Paper => LossSettings::paper(),
    };
    for stage in &mut loss.stages {
        let weights = &mut stage.weights;
        weights.energy = native.energy_weight.unwrap_or(weights.energy);
        weights.forces = native.force_weight.unwrap_or(weights.forces);
        weights.stress = native.stress_weight.unwrap_or(weights.stress);
    }
    loss.delta = native.huber_delta.get();
    let first = native.learning_rate.get();
    UpfitSettings {
        epochs: native.epochs.get(),
        batch_size: native.batch_size.get() as usize,
        loss,
        learning_rate: CosineDecay { first, last: native.min_learning_rate.unwrap_or(0.01 * first) },
        seed,
        frozen: native.freeze.clone(),
        average: native.average,
        patience: native.patience.map(|epochs| epochs.get()),
        threads,
    }
}
