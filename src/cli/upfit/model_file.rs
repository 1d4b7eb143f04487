//! Writes the new model.

use std::fs::File;
use std::io;
use std::path::Path;

use potentials::grace::TrainableGrace;

use super::paths::resolved;
use crate::atomic_file::{AtomicFile, cannot_write};
use crate::cli::CommandError;

/// Writes the model to a file beside its target first, so that the target appears complete or not at all.
pub fn write_model(model: &TrainableGrace, output: &Path, note: &str) -> Result<(), CommandError> {
    let output = &resolved(output);
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
