//! Reads the mixture with which a campaign began.

use std::path::Path;

use calm::Artifact;
use monitor::mixture_status::InitialMixture;
use serde_json::Value;
use store::Store;

use crate::exit_status::CommandError;
use crate::file_hash::verify_hash;

/// Reads the artifact from the path that the campaign last used.
///
/// # Errors
/// Fails if the file is missing or has another content.
pub async fn read(store: &Store) -> Result<InitialMixture, CommandError> {
    let campaign = store.campaign().await?;
    let resolved: Value = serde_json::from_str(&campaign.resolved_configuration)
        .map_err(|error| CommandError::Failed(format!("damaged database: the configuration: {error}")))?;
    let files = store.grade_files().await?;
    let (key, load): (_, fn(&Path) -> _) = match &files["calm.artifact"] {
        Value::String(_) => ("calm.artifact", |path| Artifact::load(path)),
        _ => ("potential.model", |path| Artifact::load_export(path)),
    };
    let path = files[key].as_str().ok_or_else(|| {
        CommandError::Input(format!("the store has no path of {key}, with which the campaign began"))
    })?;
    let path = Path::new(path);
    verify_hash(path, resolved["files"][key].as_str().unwrap_or_default())?;
    let Artifact { symbols, mixture, .. } = load(path).map_err(CommandError::input)?;
    Ok(InitialMixture { symbols, mixture })
}
