//! Handles of calculations, wherever they run.

use std::path::Path;

use serde::{Deserialize, Serialize};
use store::StoreError;

use super::blocking::blocking;
use super::calculation_runner::CalculationEnd;
use super::calculation_state::CalculationState;
use super::file_error::file_error;
use super::local::{self, LocalCalculation};
use super::slurm::{CalculationJob, Slurm};

/// Identifies a calculation.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub(super) enum CalculationHandle {
    /// A process on a host.
    Local(LocalCalculation),
    /// A batch job on a cluster.
    Slurm(CalculationJob),
}

impl CalculationHandle {
    /// Parses the form in the store; `None` for unknown forms.
    pub fn parse(text: &str) -> Option<Self> {
        serde_json::from_str(text).ok()
    }

    /// The form in the store.
    pub fn identity(&self) -> String {
        serde_json::to_string(self).expect("plain data becomes JSON")
    }

    pub fn directory(&self) -> &Path {
        match self {
            Self::Local(calculation) => &calculation.directory,
            Self::Slurm(job) => &job.directory,
        }
    }

    pub async fn inspect(&self, slurm: &Slurm) -> Result<CalculationState, StoreError> {
        match self {
            Self::Local(calculation) => Ok(calculation.inspect()),
            Self::Slurm(job) => slurm.inspect(job).await,
        }
    }

    /// Waits for its end; `None` if it was interrupted.
    pub async fn wait(&self, slurm: &Slurm) -> Result<Option<CalculationEnd>, StoreError> {
        match self {
            Self::Local(calculation) => Ok(calculation.wait().await),
            Self::Slurm(job) => slurm.wait(job).await,
        }
    }

    /// Ends what is left of it and removes its directory.
    pub async fn clear(&self, slurm: &Slurm) -> Result<(), StoreError> {
        if let Self::Slurm(job) = self {
            slurm.cancel(job).await?;
        }
        self.clone().remove().await
    }

    /// Removes the directory of a calculation that has ended.
    pub async fn remove(self) -> Result<(), StoreError> {
        let directory = self.directory().to_owned();
        let removed = blocking(move || match self {
            Self::Local(calculation) => calculation.clear(),
            // What a node still uses is removed later.
            Self::Slurm(job) => {
                local::remove(&job.directory);
                Ok(())
            }
        });
        removed.await.map_err(|error| file_error(&directory, error))
    }
}
