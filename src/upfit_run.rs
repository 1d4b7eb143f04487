//! Trains a model on labelled structures and writes its file, with the state of the training on disk.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use potentials::grace::TrainableGrace;
use serde_json::{Map, Value, json};
use tokio_util::sync::CancellationToken;
use upfit::{LabelledFrame, TrainingData, TrainingEvent, UpfitError, UpfitOutcome, UpfitSettings, data_hash};

use crate::atomic_file::{AtomicFile, cannot_write};
use crate::exit_status::CommandError;
use crate::labelled_frames::DataFile;

/// A training and its files.
pub struct UpfitRun {
    /// The model to begin with.
    pub model: TrainableGrace,
    /// Labelled structures.
    pub data: TrainingData,
    /// What the note in the new model says of its origin, see [`note`].
    pub note: Value,
    /// How it is trained.
    pub settings: UpfitSettings,
    /// File for the new model.
    pub output: PathBuf,
    /// File of the state. It remains until [`remove_checkpoint`].
    pub checkpoint: PathBuf,
}

impl UpfitRun {
    /// Trains, or continues from the state, and writes the model; before that calls `finish`. `None` if `stop` was cancelled; the same
    /// training continues later. As long as the state is there, a training that has ended gives the same model again at once.
    ///
    /// # Errors
    /// Those of [`upfit::run`], as `to_error` makes them; a file that cannot be written; `finish`'s.
    pub fn run<E: From<CommandError>>(
        self,
        stop: &CancellationToken,
        mut show: impl FnMut(&TrainingEvent<'_>),
        finish: impl FnOnce(&UpfitOutcome) -> Result<(), CommandError>,
        to_error: fn(UpfitError) -> E,
    ) -> Result<Option<UpfitOutcome>, E> {
        let Self { model, data, note, settings, output, checkpoint } = self;
        let is_stopped = || stop.is_cancelled();
        let trained =
            upfit::run(model, &data, &settings, Some(&checkpoint), &is_stopped, |event| show(&event));
        let Some(outcome) = trained.map_err(to_error)? else { return Ok(None) };
        finish(&outcome)?;
        write_model(&outcome.model, &output, &note.to_string())?;
        Ok(Some(outcome))
    }
}

/// Removes the state of a training whose model, and what else comes of it, is in its files.
pub fn remove_checkpoint(checkpoint: &Path) -> Result<(), CommandError> {
    match fs::remove_file(checkpoint) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(cannot_write(checkpoint, error)),
        _ => Ok(()),
    }
}

/// Where the weights come from, for the model file, with what the file before said: its `name`, the data and the settings. It names no
/// times and no number of threads, so that the same training gives the same bytes.
pub fn note(
    (name, model): (&str, &TrainableGrace),
    data: &TrainingData,
    files: &[DataFile],
    settings: &UpfitSettings,
) -> Value {
    let hash = blake3::hash(model.file_bytes()).to_string();
    let set = |frames: &[LabelledFrame]| json!({ "structures": frames.len(), "hash": data_hash(frames) });
    let settings: Map<_, _> =
        settings.entries().into_iter().map(|(name, value)| (name, Value::from(value))).collect();
    json!({
        "program": concat!("calmwalk ", env!("CARGO_PKG_VERSION"), " upfit"),
        "model": { "file": name, "hash": hash },
        "files": files,
        "training": set(&data.training),
        "validation": set(&data.validation),
        "settings": settings,
        "parent": model.note().map(|text| serde_json::from_str(&text).unwrap_or(Value::String(text))),
    })
}

/// Writes the model to a file beside its target first, so that the target appears complete or not at all.
fn write_model(model: &TrainableGrace, output: &Path, note: &str) -> Result<(), CommandError> {
    let output = &output.canonicalize().unwrap_or_else(|_| output.to_owned());
    let parent = output.parent().filter(|parent| !parent.as_os_str().is_empty());
    // The next start removes it if this process is killed.
    let prefix = format!(".{}.", output.file_name().unwrap_or_default().to_string_lossy());
    let mut builder = tempfile::Builder::new();
    let part = builder.prefix(&prefix).suffix(".part").tempfile_in(parent.unwrap_or(Path::new(".")));
    let part = part.map_err(|error| cannot_write(output, error))?.into_temp_path();
    model.write(&part, note).map_err(|error| cannot_write(output, error))?;
    // The checkpoint is removed afterwards, so the model must be readable.
    let written = TrainableGrace::load(&part).map_err(CommandError::failed)?;
    if written.weights() != model.weights() {
        return Err(CommandError::Failed(format!(
            "{}: the model was not written as it is",
            output.display()
        )));
    }
    let mut file = AtomicFile::create(output)?;
    let copied = File::open(&part).and_then(|mut written| io::copy(&mut written, &mut file));
    copied.map_err(|error| cannot_write(output, error))?;
    file.finish()
}
