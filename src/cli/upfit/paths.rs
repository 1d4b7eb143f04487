//! Finds errors in paths before hours of work.

use std::collections::BTreeMap;
use std::path::Path;

use super::left_parts::remove_left_parts;
use crate::atomic_file::{check_outputs, resolved};
use crate::cli::CommandError;

/// Checks that no file of structures is given twice, and that outputs can be written, and replace neither an input nor each
/// other. Two names of one file are recognised. Removes what a killed process left beside the outputs. Each file of structures
/// comes with a description.
pub fn check_paths(
    model: &Path,
    structures: &[(&Path, &str)],
    outputs: &[&Path],
) -> Result<(), CommandError> {
    refuse_the_same(structures)?;
    let inputs = [&[(model, "the model")], structures].concat();
    check_outputs(outputs.iter().copied(), &inputs)?;
    outputs.iter().try_for_each(|output| remove_left_parts(&resolved(output)))
}

/// Refuses two names of one file. Each comes with a description.
fn refuse_the_same(files: &[(&Path, &str)]) -> Result<(), CommandError> {
    let mut known = BTreeMap::new();
    for (path, what) in files {
        if let Some((other, of_other)) = known.insert(resolved(path), (path, what)) {
            let (path, other) = (path.display(), other.display());
            return Err(CommandError::Input(format!(
                "{path}, {what}, is the same file as {other}, {of_other}; expected different files"
            )));
        }
    }
    Ok(())
}
