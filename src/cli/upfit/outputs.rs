//! Finds errors in paths before hours of work.

use super::fine_tuning::FineTuning;
use crate::atomic_file::{AtomicFile, refuse_to_replace};
use crate::cli::CommandError;

/// Checks that outputs can be written, and replace neither an input nor each other.
pub fn check_outputs(request: &FineTuning) -> Result<(), CommandError> {
    let FineTuning { model, data, validation, output, checkpoint, figure, .. } = request;
    let outputs = || [output.as_path(), checkpoint.as_path()].into_iter().chain(figure.as_deref());
    let data = data.paths().map(|path| (path, "a file of training data"));
    let validation = validation.iter().flat_map(|files| files.paths());
    let validation = validation.map(|path| (path, "a file of validation data"));
    let inputs: Vec<_> =
        std::iter::once((model.as_path(), "the model")).chain(data).chain(validation).collect();
    for (number, output) in outputs().enumerate() {
        refuse_to_replace(output, inputs.iter().copied())?;
        if outputs().take(number).any(|other| other == output) {
            return Err(CommandError::Input(format!("{}: named for two outputs", output.display())));
        }
        AtomicFile::create(output).map(drop)?;
    }
    Ok(())
}
