//! A campaign with a version of the potential other than that of its configuration.

use std::path::{Path, PathBuf};

use potentials::grace::GraceModel;

use super::LoadedCampaign;
use super::loader::Loader;
use crate::config::{ConfigError, RefitSection, TestSetSection};
use crate::exit_status::CommandError;
use crate::file_hash;
use crate::loaded_model::LoadedModel;
use crate::process_config::{DeviceModel, HashedFile, ModelFiles, WalkerModel};
use crate::refit::settings::{RefitSettings, TestSet};
use crate::versions::VersionOnDisk;

impl LoadedCampaign {
    /// The campaign with this version. Its configuration and identity remain.
    ///
    /// # Errors
    /// Files of the version that do not belong together, or training frames that its model cannot evaluate.
    pub fn with_version(&self, found: VersionOnDisk) -> Result<Self, ConfigError> {
        let config = found.applied_to(&self.config);
        let loader = Loader { path: &self.path, text: &self.text, config: &config };
        let model = loader.model()?;
        let artifact = loader.artifact(&model)?;
        let training = loader.training_frames(&model, &artifact.mixture)?;
        Ok(Self { model, artifact, training, version: Some(found), ..self.clone() })
    }

    /// Number of the version of the potential; 0 is that of the configuration.
    pub fn version_number(&self) -> u32 {
        self.version.as_ref().map_or(0, |found| found.version.version)
    }

    /// The model of version 0.
    pub fn first_model(&self) -> Result<HashedFile, CommandError> {
        self.configured_file("potential.model", self.config.potential.model.get_ref())
    }

    /// The artifact of the mixture.
    ///
    /// # Errors
    /// The campaign has none: its mixture is that of the model's export.
    pub fn mixture_file(&self) -> Result<HashedFile, CommandError> {
        match (&self.version, &self.config.calm.artifact) {
            (Some(found), _) => Ok(found.mixture.clone()),
            (None, Some(path)) => self.configured_file("calm.artifact", path.get_ref()),
            (None, None) => Err(CommandError::input("[refit] needs calm.artifact")),
        }
    }

    /// The files that walkers load the model from.
    pub fn model_files(&self) -> Result<ModelFiles, CommandError> {
        let export = match &self.version {
            Some(found) => found.model.clone(),
            None => self.first_model()?,
        };
        // A model with a mixture of its own has the projection already.
        let projected = GraceModel::has_projection(&export.path).map_err(CommandError::input)?;
        let has_artifact = self.version.is_some() || self.config.calm.artifact.is_some();
        let artifact = (has_artifact && !projected).then(|| self.mixture_file()).transpose()?;
        Ok(ModelFiles { export, artifact, precision: self.config.potential.precision })
    }

    /// What walkers of this host load the model from.
    pub fn walker_model(&self) -> Result<WalkerModel, CommandError> {
        let LoadedModel::Python(model) = &self.model else {
            return Ok(WalkerModel::Grace(self.model_files()?));
        };
        let artifact = model.projection().is_some().then(|| self.mixture_file()).transpose()?;
        let description = model.description().clone();
        Ok(WalkerModel::Python(Box::new(DeviceModel { description, artifact })))
    }

    /// The section `[refit]` with absolute paths and hashes.
    pub fn refit_settings(&self, refit: &RefitSection) -> Result<RefitSettings, CommandError> {
        let replay =
            refit.replay.iter().enumerate().map(|(number, path)| {
                self.configured_file(&format!("refit.replay[{number}]"), path.get_ref())
            });
        let sets = |sets: &[TestSetSection]| sets.iter().map(test_set).collect::<Result<_, _>>();
        Ok(RefitSettings {
            replay: replay.collect::<Result<_, _>>()?,
            replay_weight: refit.replay_weight.get(),
            method: refit.method.clone(),
            held_out: refit.held_out,
            max_replay_error_ratio: refit.max_replay_error_ratio.get(),
            max_held_out_error_ratio: refit.max_held_out_error_ratio.get(),
            threads: refit.threads,
            start: refit.start,
            control_frames: refit.control_frames,
            test_sets: sets(&refit.test_sets)?,
            comparisons: sets(&refit.comparisons)?,
        })
    }

    fn configured_file(&self, key: &str, path: &Path) -> Result<HashedFile, CommandError> {
        Ok(HashedFile { path: absolute(path)?, hash: self.hash_of(key) })
    }
}

fn test_set(set: &TestSetSection) -> Result<TestSet, CommandError> {
    let path = absolute(set.file.get_ref())?;
    let hash = file_hash::hash(&path);
    let hash = hash.map_err(|error| {
        CommandError::Input(format!("[refit], '{}': cannot read {}: {error}", set.name, path.display()))
    })?;
    Ok(TestSet { name: set.name.clone(), file: HashedFile { path, hash } })
}

fn absolute(path: &Path) -> Result<PathBuf, CommandError> {
    std::path::absolute(path).map_err(CommandError::failed)
}
