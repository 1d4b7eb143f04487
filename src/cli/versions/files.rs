//! The files of a version on this host.

use calm::Artifact;
use potentials::grace::{GraceModel, Precision};
use serde_json::Value;
use store::Store;
use tempfile::TempDir;

use super::{CommandError, registered};
use crate::process_config::{HashedFile, ModelFiles};
use crate::replay::{self, ARTIFACT, MODEL, RelocatedFilesArgs};
use crate::versions::VersionOnDisk;

/// The files of a version.
pub struct VersionSource {
    /// The model.
    pub model: HashedFile,
    /// The artifact of its mixture.
    pub mixture: HashedFile,
    /// Copies of what is in the store.
    _copies: TempDir,
}

impl VersionSource {
    /// Finds those of a registered version: in the store, or where the campaign last found those of version 0.
    ///
    /// # Errors
    /// There is no such version, it was refused, or a file of version 0 is missing or has another content.
    pub async fn find(store: &Store, number: u32, moved: &RelocatedFilesArgs) -> Result<Self, CommandError> {
        let copies = tempfile::tempdir().map_err(CommandError::failed)?;
        if number == 0 {
            let [model, mixture] = configured(store, moved).await?;
            return Ok(Self { model, mixture, _copies: copies });
        }
        let versions = store.versions().await?;
        let found = VersionOnDisk::find(store, registered(&versions, number)?, copies.path()).await?;
        Ok(Self { model: found.model, mixture: found.mixture, _copies: copies })
    }

    /// The mixture, as the file has it.
    pub fn artifact(&self) -> Result<Artifact, CommandError> {
        Artifact::load(&self.mixture.path).map_err(CommandError::input)
    }

    /// The files from which the model is loaded with a projection of its features, in double precision.
    pub fn model_files(&self) -> Result<ModelFiles, CommandError> {
        let projected = GraceModel::has_projection(&self.model.path).map_err(CommandError::input)?;
        let artifact = (!projected).then(|| self.mixture.clone());
        Ok(ModelFiles { export: self.model.clone(), artifact, precision: Precision::default() })
    }
}

/// Model and artifact of the configuration.
async fn configured(store: &Store, moved: &RelocatedFilesArgs) -> Result<[HashedFile; 2], CommandError> {
    let (resolved, known) = (replay::resolved(&store.campaign().await?)?, store.grade_files().await?);
    if !matches!(resolved["files"][ARTIFACT], Value::String(_)) {
        return Err(CommandError::Input(
            "the campaign began with the mixture of its model, so version 0 has no artifact: expected a campaign with calm.artifact"
                .to_owned(),
        ));
    }
    let find = |key: &str| -> Result<HashedFile, CommandError> {
        let path = replay::find_one(key, &resolved, &known, moved)?;
        Ok(HashedFile { path, hash: resolved["files"][key].as_str().unwrap_or_default().to_owned() })
    };
    Ok([find(MODEL)?, find(ARTIFACT)?])
}
