//! A training from files to a file: reads the data, trains, and writes model and figure.

use std::collections::HashSet;
use std::io::Write;
use std::path::{Path, PathBuf};

use ::upfit::{LabelledFrame, TrainingData, TrainingEvent, UpfitOutcome, UpfitSettings, data_hash};
use figures::to_svg;
use potentials::grace::TrainableGrace;
use serde_json::Value;
use tokio_util::sync::CancellationToken;

use super::figure;
use super::paths::check_paths;
use crate::atomic_file::{AtomicFile, cannot_write};
use crate::cli::CommandError;
use crate::labelled_frames::{DataFile, check_formats, command_error, read_frames};
use crate::output::{count, log_and_warn, print_stderr};
use crate::structure_files::StructureFiles;
use crate::upfit_run::{self, UpfitRun};

/// What to train, with which data, and where results go.
pub struct FineTuning {
    /// The GRACE model.
    pub model: PathBuf,
    /// Labelled structures.
    pub data: StructureFiles,
    /// Structures to validate with. Without them, a share of `data` is held out.
    pub validation: Option<StructureFiles>,
    /// That share, 0 up to, not including, 1.
    pub validation_share: f64,
    /// How to train.
    pub settings: UpfitSettings,
    /// File for the new model.
    pub output: PathBuf,
    /// File of the state, which is removed at the end.
    pub checkpoint: PathBuf,
    /// File for the learning curves.
    pub figure: Option<PathBuf>,
}

/// A training whose model is written.
pub struct FineTuned {
    pub outcome: UpfitOutcome,
    /// Where the weights come from, as it stands in the model.
    pub note: Value,
}

/// Trains, from the checkpoint if there is one, and writes the results. Returns `None` if `stop` was cancelled; then the same call
/// continues.
///
/// # Errors
/// Wrong files, data or settings; a training that fails; a file that cannot be written.
pub fn fine_tune(
    request: &FineTuning,
    stop: &CancellationToken,
    mut show: impl FnMut(&TrainingEvent<'_>),
) -> Result<Option<FineTuned>, CommandError> {
    let settings = &request.settings;
    let data = request.data.paths().map(|path| (path, "a file of training data"));
    let validation = request.validation.iter().flat_map(StructureFiles::paths);
    let structures: Vec<_> = data.chain(validation.map(|path| (path, "a file of validation data"))).collect();
    check_formats(structures.iter().map(|(path, _)| *path))?;
    let outputs = [&request.output, &request.checkpoint].into_iter().chain(&request.figure);
    check_paths(&request.model, &structures, &outputs.map(PathBuf::as_path).collect::<Vec<_>>())?;
    let model = TrainableGrace::load(&request.model).map_err(CommandError::input)?;
    let Some((data, files)) = read_data(request, stop)? else { return Ok(None) };
    let name = request.model.display().to_string();
    let note = upfit_run::note((&name, &model), &data, &files, settings);
    let run = UpfitRun {
        model,
        data,
        note: note.clone(),
        settings: settings.clone(),
        output: request.output.clone(),
        checkpoint: request.checkpoint.clone(),
    };
    let finish = |outcome: &UpfitOutcome| match &request.figure {
        Some(path) => write_curves(path, outcome),
        None => Ok(()),
    };
    let Some(outcome) = run.run(stop, &mut show, finish, command_error)? else { return Ok(None) };
    upfit_run::remove_checkpoint(&request.checkpoint)?;
    Ok(Some(FineTuned { outcome, note }))
}

/// Both sets, and the files that they come from; `None` if it was asked to stop.
fn read_data(
    request: &FineTuning,
    stop: &CancellationToken,
) -> Result<Option<(TrainingData, Vec<DataFile>)>, CommandError> {
    let settings = &request.settings;
    let Some((frames, mut sources)) = read_frames(&request.data, stop)? else { return Ok(None) };
    let data = match &request.validation {
        None => ::upfit::split(frames, request.validation_share, settings.seed).map_err(command_error)?,
        Some(files) => {
            let Some((validation, others)) = read_frames(files, stop)? else { return Ok(None) };
            others.iter().try_for_each(|file| file.refuse_copy(&sources))?;
            warn_of_known_structures(&frames, &validation);
            sources.extend(others.into_iter().map(DataFile::for_validation));
            TrainingData { training: frames, validation }
        }
    };
    if settings.patience.is_some() && data.validation.is_empty() {
        let message = "--patience: expected a validation set, not --validation-share 0";
        return Err(CommandError::input(message));
    }
    let [training, validation] = [data.training.len(), data.validation.len()];
    print_stderr(format_args!(
        "{} to train with, {} for validation",
        count(training as u64, "structure"),
        count(validation as u64, "structure")
    ));
    Ok(Some((data, sources)))
}

/// Warns of structures of the validation set that the model is trained with: its errors would be too small.
fn warn_of_known_structures(training: &[LabelledFrame], validation: &[LabelledFrame]) {
    let hash = |frame: &LabelledFrame| {
        data_hash(std::slice::from_ref(&LabelledFrame { weight: 1.0, ..frame.clone() }))
    };
    let known: HashSet<_> = training.iter().map(hash).collect();
    let mut both = validation.iter().filter(|frame| known.contains(&hash(frame)));
    if let Some(first) = both.next() {
        let number = 1 + both.count() as u64;
        log_and_warn(format_args!(
            "{} of the validation set, such as {}, {} in the training set too: validation errors are too small",
            count(number, "structure"),
            first.place,
            if number == 1 { "is" } else { "are" }
        ));
    }
}

fn write_curves(path: &Path, outcome: &UpfitOutcome) -> Result<(), CommandError> {
    let mut file = AtomicFile::create(path)?;
    let text = to_svg(&figure::learning_curves(&outcome.history));
    file.write_all(text.as_bytes()).map_err(|error| cannot_write(path, error))?;
    file.finish()
}
