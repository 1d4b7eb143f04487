//! Locates the files that determine grades.

use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::config::Config;
use crate::exit_status::CommandError;
use crate::file_hash;

/// Key of the model in the configuration, as those below.
pub const MODEL: &str = "potential.model";
pub const ARTIFACT: &str = "calm.artifact";
const TRAINING_FRAMES: &str = "calm.training_frames";

/// Files that are not where the campaign last found them.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct RelocatedFilesArgs {
    /// Path of the model file, if it has moved since the last run
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Path of the artifact, if it has moved
    #[arg(long, value_name = "FILE")]
    artifact: Option<PathBuf>,
    /// Path of the training frames, if they have moved; only a replay reads them
    #[arg(long, value_name = "FILE")]
    training_frames: Option<PathBuf>,
}

/// Sets the paths in `config`, from the options or from where the campaign last found them (`found`, paths by key).
/// Checks that the contents are those with which the campaign started.
pub fn find(
    config: &mut Config,
    resolved: &Value,
    found: &Value,
    moved: &RelocatedFilesArgs,
) -> Result<(), CommandError> {
    let calm = &mut config.calm;
    let files = [
        (MODEL, Some(&mut config.potential.model)),
        (ARTIFACT, calm.artifact.as_mut()),
        (TRAINING_FRAMES, calm.training_frames.as_mut()),
    ];
    for (key, place) in files {
        if let Some(place) = place {
            *place.get_mut() = find_one(key, resolved, found, moved)?;
        }
    }
    Ok(())
}

/// The path of one file, by its key.
pub fn find_one(
    key: &str,
    resolved: &Value,
    found: &Value,
    moved: &RelocatedFilesArgs,
) -> Result<PathBuf, CommandError> {
    let (option, moved) = match key {
        MODEL => ("--model", &moved.model),
        ARTIFACT => ("--artifact", &moved.artifact),
        _ => ("--training-frames", &moved.training_frames),
    };
    let path = moved.clone().or_else(|| found[key].as_str().map(PathBuf::from));
    let path = path.ok_or_else(|| {
        CommandError::Input(format!("the store has no path of {key}; give it with {option} FILE"))
    })?;
    let expected = resolved["files"][key].as_str().unwrap_or_default();
    check(&path, expected)
        .map_err(|error| CommandError::Input(format!("{key}: {error}; give its path with {option} FILE")))?;
    Ok(path)
}

fn check(path: &Path, expected: &str) -> Result<(), String> {
    let shown = path.display();
    let found = file_hash::hash(path).map_err(|error| format!("cannot read {shown}: {error}"))?;
    if found == expected {
        return Ok(());
    }
    Err(format!("{shown} has another content (BLAKE3 {found}) than that of the campaign ({expected})"))
}
