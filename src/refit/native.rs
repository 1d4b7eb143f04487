//! Training by calmwalk itself.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use potentials::grace::TrainableGrace;
use tokio_util::sync::CancellationToken;
use upfit::{
    CosineDecay, EnergyDeviations, EnergyZero, FarStructure, LossSettings, SetErrors, TrainingData,
    TrainingEvent, UpfitSettings,
};

use super::failure::RefitFailure;
use super::settings::RefitSettings;
use crate::config::{NativeRefit, RefitLoss};
use crate::exit_status::CommandError;
use crate::labelled_frames::{DataFile, read_frames};
use crate::process_config::HashedFile;
use crate::structure_files::{StructureFiles, StructureReadingArgs};
use crate::upfit_run::{self, UpfitRun};
use crate::wording;

/// Time between two reports within an epoch.
const LINE_INTERVAL: Duration = Duration::from_secs(30);

/// A training with the labels of a campaign, or with others in their place.
pub struct NativeTraining<'a> {
    /// The model to begin with, and what it is called in the note of the new one.
    pub begin: (&'a HashedFile, String),
    /// Labels besides the replay data.
    pub labels: &'a Path,
    /// File for the new model.
    pub output: PathBuf,
}

/// Where what a training says goes, a line at a time.
pub struct TrainingReport<'a> {
    /// Where it is.
    pub progress: &'a dyn Fn(String),
    /// What the user should know of the data.
    pub warning: &'a dyn Fn(String),
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
    /// How the zero of the energies was moved.
    pub zero: EnergyZero,
    /// How the labels' energies differ from those of the model before the first update.
    pub spread: EnergyDeviations,
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
        TrainingReport { progress: report, warning: warn }: TrainingReport<'_>,
    ) -> Result<Option<TrainingSummary>, RefitFailure> {
        let (begin, name) = self.begin;
        let model = TrainableGrace::load(&begin.path).map_err(RefitFailure::of_model)?;
        let files = files(settings, self.labels)?;
        let directories: Vec<_> =
            files.files.iter().filter_map(|file| file.path.parent().map(Path::to_owned)).collect();
        let read = read_frames(&files, stop).map_err(RefitFailure::of_input)?;
        let Some((frames, sources)) = read else { return Ok(None) };
        let data = upfit::split(frames, native.validation_share, rng_seed);
        let data = data.map_err(RefitFailure::of_training)?;
        warn_of_validation(&data, files.files.len() - 1, warn);
        let upfit_settings = upfit_settings(native, rng_seed, settings.threads());
        // Without directories, so that the model has the same bytes wherever the campaign is.
        let sources: Vec<_> = sources.into_iter().map(DataFile::without_directory).collect();
        let note = upfit_run::note((&name, &model), &data, &sources, &upfit_settings);
        let [structures, validation] = [&data.training, &data.validation].map(|set| set.len() as u64);
        let checkpoint = self.output.with_extension("npz.upfit");
        let epochs = upfit_settings.epochs;
        let run = UpfitRun { model, data, note, settings: upfit_settings, output: self.output, checkpoint };
        let mut line = Instant::now();
        let outcome = run.run(
            stop,
            |event| match event {
                TrainingEvent::Begun { zero, spread, .. } => {
                    let texts = [wording::upfit::zero(zero), wording::upfit::spread(spread)];
                    texts.iter().flatten().for_each(|text| warn(text.clone()));
                }
                TrainingEvent::Update(progress) if line.elapsed() > LINE_INTERVAL => {
                    line = Instant::now();
                    let speed = (progress.updates_per_second, progress.seconds_left);
                    report(progress_text((progress.epoch, epochs), &progress.errors, speed));
                }
                TrainingEvent::Update(_) => {}
                TrainingEvent::Epoch { record, seconds_left } => {
                    line = Instant::now();
                    let errors = record.errors.validation.as_ref().unwrap_or(&record.errors.training);
                    let speed = (record.updates_per_second, *seconds_left);
                    report(progress_text((record.epoch, epochs), errors, speed));
                }
            },
            |_| Ok(()),
            RefitFailure::of_training,
        )?;
        Ok(outcome.map(|outcome| TrainingSummary {
            structures,
            validation,
            epochs: outcome.history.len() as u64,
            zero: outcome.zero,
            spread: without_directories(outcome.spread, &directories),
        }))
    }
}

/// Warns if validation has replay data alone: the labels of the campaign belong to so few seed structures that none is held out.
fn warn_of_validation(data: &TrainingData, labels: usize, warn: &dyn Fn(String)) {
    if !data.validation.is_empty() && data.validation.iter().all(|frame| frame.file != labels) {
        warn(
            "the validation set has replay data alone, since the labels to train on belong to too few seed structures: the weights are \
             chosen without them. refit.method.native.validation_share = 0 takes the last weights"
                .to_owned(),
        );
    }
}

/// Names the files of these directories by their names, so that a record does not depend on where they are. A directory may lie in another one.
fn without_directories(spread: EnergyDeviations, directories: &[PathBuf]) -> EnergyDeviations {
    let short = |place: String| {
        let inside = directories
            .iter()
            .filter_map(|directory| place.strip_prefix(directory.to_str()?)?.strip_prefix('/'));
        inside.min_by_key(|name| name.len()).map(str::to_owned).unwrap_or(place)
    };
    let far = spread.far.into_iter().map(|far| FarStructure { place: short(far.place), ..far });
    EnergyDeviations { far: far.collect(), ..spread }
}

/// Where a training is: the epoch and their number, the errors, updates per second and the time to the end, s.
fn progress_text(
    (epoch, epochs): (u64, u64),
    errors: &SetErrors,
    (updates_per_second, seconds_left): (f64, Option<f64>),
) -> String {
    let stress = errors.stress_mae.map(|stress| format!(", stress MAE {:.2} meV/Å³", 1e3 * stress));
    format!(
        "epoch {epoch} of {epochs}, force MAE {:.1} meV/Å, energy MAE {:.2} meV/atom{}, {updates_per_second:.1} updates/s{}",
        1e3 * errors.force_mae,
        1e3 * errors.energy_mae,
        stress.unwrap_or_default(),
        wording::upfit::time_left(seconds_left)
    )
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
    let first = native.first_learning_rate();
    UpfitSettings {
        epochs: native.epochs(),
        batch_size: native.batch_size.get() as usize,
        optimiser: native.optimiser,
        loss,
        learning_rate: CosineDecay { first, last: native.min_learning_rate.unwrap_or(0.01 * first) },
        seed,
        frozen: native.freeze.clone(),
        average: native.average,
        patience: native.patience.map(|epochs| epochs.get()),
        threads,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_has_errors_speed_and_the_expected_end() {
        let errors = SetErrors {
            structures: 3,
            loss: 0.25,
            energy_mae: 0.0012,
            energy_rmse: 0.3,
            force_mae: 0.0431,
            force_rmse: 0.3,
            stress_mae: Some(5e-4),
            stress_rmse: Some(0.3),
        };
        let text = progress_text((12, 50), &errors, (2.34, Some(180.0)));
        let expected = "epoch 12 of 50, force MAE 43.1 meV/Å, energy MAE 1.20 meV/atom, stress MAE 0.50 meV/Å³, 2.3 updates/s, \
                        3 minutes left";
        assert_eq!(text, expected);
        let text = progress_text((1, 2), &SetErrors { stress_mae: None, ..errors }, (2.34, None));
        assert_eq!(text, "epoch 1 of 2, force MAE 43.1 meV/Å, energy MAE 1.20 meV/atom, 2.3 updates/s");
    }

    #[test]
    fn records_do_not_depend_on_directories() {
        let places = ["/a/refit/1/train.extxyz:7 (candidate x/1)", "/b/replay.xyz:1", "other.xyz:3"];
        let far = places.map(|place| FarStructure { place: place.to_owned(), difference: 1.0 });
        let spread = EnergyDeviations { far: far.to_vec(), ..EnergyDeviations::default() };
        let found = without_directories(spread, &["/b".into(), "/a".into(), "/a/refit/1".into()]);
        let found: Vec<_> = found.far.iter().map(|far| far.place.as_str()).collect();
        assert_eq!(found, ["train.extxyz:7 (candidate x/1)", "replay.xyz:1", "other.xyz:3"]);
    }
}
