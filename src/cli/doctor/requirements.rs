//! What a campaign needs of a machine.

use std::path::Path;

use workers::labeller::BatchSystem;

use super::check::MachineCheck;
use crate::campaign::LoadedCampaign;
use crate::cli::CommandError;
use crate::config::Config;
use crate::label_method::MethodConfig;
use crate::{disk_forecast, runtime};

/// A configuration, and what its files and its label method say.
pub struct Requirements {
    /// The configuration.
    pub config: Config,
    /// Whether its labels can be made.
    labels: Result<(), String>,
    /// `None` if the label method is not there, without which a campaign cannot be loaded.
    campaign: Option<Result<LoadedCampaign, String>>,
}

impl Requirements {
    /// Reads a configuration and the files that it names, and asks its label method for its version.
    ///
    /// # Errors
    /// A configuration that is wrong in itself.
    pub fn read(path: &Path) -> Result<Self, CommandError> {
        let loaded = Config::load(path)?;
        let method = MethodConfig::from_section(&loaded.config.label);
        let labels = method.and_then(|method| method.identity()).map(drop).map_err(|error| error.to_string());
        let load = || LoadedCampaign::load(path).map_err(|error| error.to_string());
        let campaign = labels.is_ok().then(load);
        Ok(Self { config: loaded.config, labels, campaign })
    }

    /// Number of walkers on this machine.
    pub fn walkers(&self) -> u32 {
        runtime::wanted_walkers(&self.config)
    }

    /// Shared memory for the start of the campaign, bytes, if its files could be read.
    pub fn shared_memory(&self) -> Option<u64> {
        let campaign = self.loaded()?;
        runtime::shared_memory_needed(campaign, &campaign.artifact.mixture).ok()
    }

    /// Disk space of the whole campaign, bytes, if its files could be read.
    pub fn disk(&self) -> Option<u64> {
        let forecast = disk_forecast::estimate(self.loaded()?);
        Some(forecast.bytes() + forecast.declined + disk_forecast::WAL_BYTES)
    }

    /// The launcher and the Python environment of its potential.
    pub fn python(&self) -> Option<(&[String], &Path)> {
        self.config.potential.python.as_ref().map(|python| (&python.launcher[..], &*python.environment))
    }

    /// Whether its labels are jobs of Slurm.
    pub fn slurm(&self) -> bool {
        matches!(self.config.label.batch_system, Some(BatchSystem::Slurm))
    }

    /// Its files and its label method.
    pub fn checks(&self) -> Vec<MachineCheck> {
        vec![self.label_method().required_if(true), self.files().required_if(true)]
    }

    fn label_method(&self) -> MachineCheck {
        const NEEDED_FOR: &str = "labels of this campaign";
        let name = self.config.label.method.name();
        match &self.labels {
            Ok(()) => MachineCheck::present("label method", format!("{name} is ready"), NEEDED_FOR),
            Err(error) => {
                let advice =
                    format!("correct label.method.{name}, or install what it names (docs/dft-codes.md)");
                MachineCheck::absent("label method", format!("{name}: {error}"), NEEDED_FOR, advice)
            }
        }
    }

    fn files(&self) -> MachineCheck {
        const NAME: &str = "files";
        const NEEDED_FOR: &str = "model, mixture and seed structures of this campaign";
        match &self.campaign {
            Some(Ok(_)) => MachineCheck::present(NAME, "fit together", NEEDED_FOR),
            Some(Err(error)) => {
                MachineCheck::absent(NAME, error.clone(), NEEDED_FOR, "calmwalk validate CONFIG says more")
            }
            None => MachineCheck::absent(
                NAME,
                "not read: the label method is missing",
                NEEDED_FOR,
                "ask again when it is there",
            ),
        }
    }

    fn loaded(&self) -> Option<&LoadedCampaign> {
        self.campaign.as_ref()?.as_ref().ok()
    }
}
