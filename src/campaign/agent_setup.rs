//! What agents on other hosts get of a campaign.

use std::path::Path;

use bridge::PythonSettings;
use orchestrator::selector::CampaignMode;

use super::LoadedCampaign;
use crate::exit_status::CommandError;
use crate::file_hash;
use crate::loaded_model::LoadedModel;
use crate::process_config::{AgentConfig, AgentModel, AgentPythonModel, HashedFile};

impl LoadedCampaign {
    /// Configuration of the agents.
    ///
    /// # Errors
    /// A file of the model that cannot be read.
    pub fn agent_config(&self) -> Result<AgentConfig, CommandError> {
        let model = match &self.config.potential.python {
            None => AgentModel::Grace(self.model_files()?),
            Some(_) => AgentModel::Python(Box::new(self.agent_python_model()?)),
        };
        let run = &self.config.run;
        Ok(AgentConfig {
            model,
            settings: self.walk_settings(),
            message_bytes: self.largest_message(),
            heartbeat_timeout: self.config.walker_heartbeat_timeout().as_secs_f64(),
            max_restarts: run.max_restarts,
            has_versions: self.config.refit.is_some(),
        })
    }

    fn agent_python_model(&self) -> Result<AgentPythonModel, CommandError> {
        let (LoadedModel::Python(model), Some(largest)) = (&self.model, self.largest_seed_structure()) else {
            return Err(CommandError::input("the campaign has no model in Python, or no seed structure"));
        };
        let settings = self.config.python_settings();
        let (Some(device), Some(first)) = (model.devices().first(), settings.first()) else {
            return Err(CommandError::input("the model has no device"));
        };
        let adapter = PythonSettings::adapter_file(&first.adapter).map(|(file, _)| hashed(file));
        Ok(AgentPythonModel {
            reference: device.info().reference.clone(),
            is_reproducible: self.config.campaign.mode == CampaignMode::Reproducible,
            model: first.model.as_deref().filter(|path| path.is_file()).map(hashed).transpose()?,
            adapter: adapter.transpose()?,
            artifact: model.projection().is_some().then(|| self.mixture_file()).transpose()?,
            largest: largest.clone(),
            settings,
        })
    }
}

fn hashed(path: &Path) -> Result<HashedFile, CommandError> {
    let hash = file_hash::hash(path);
    let hash =
        hash.map_err(|error| CommandError::Input(format!("cannot read {}: {error}", path.display())))?;
    Ok(HashedFile { path: path.to_owned(), hash })
}
