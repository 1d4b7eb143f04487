//! Reads the mixture with which a campaign, or the version of the potential that it uses, began.

use std::path::Path;

use calm::Artifact;
use monitor::mixture_status::InitialMixture;
use serde_json::Value;
use store::Store;

use crate::exit_status::CommandError;
use crate::file_hash::verify_hash;
use crate::versions::{self, VersionOnDisk};

/// Reads the artifact of the version of the potential that the newest mixture belongs to, or from the path that the campaign last
/// used.
///
/// # Errors
/// Fails if the file is missing or has another content.
pub async fn read(store: &Store) -> Result<InitialMixture, CommandError> {
    let newest = store.newest_mixture().await?.version;
    if let Some(decision) = versions::taken_up_before(store, newest).await? {
        let copies = tempfile::tempdir().map_err(CommandError::failed)?;
        let found = VersionOnDisk::taken_up_by(store, &decision, copies.path()).await?;
        let Artifact { symbols, mixture, .. } =
            Artifact::load(&found.mixture.path).map_err(CommandError::input)?;
        return Ok(InitialMixture { symbols, mixture });
    }
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
