//! A calculation that was begun, wherever it runs.

use std::path::Path;

use serde::{Deserialize, Serialize};
use store::StoreError;

use super::calculation_runner::CalculationEnd;
use super::code::{blocking, file};
use super::local::{self, LocalCalculation};
use super::slurm::{Job, Slurm};

/// What finds a calculation again.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub(super) enum CalculationHandle {
    /// A process of a host.
    Local(LocalCalculation),
    /// A job of a cluster.
    Slurm(Job),
}

/// What is found of one.
#[derive(Debug, PartialEq)]
pub(super) enum CalculationState {
    /// It has ended, and waits to be read.
    Ended(CalculationEnd),
    Running,
    /// Everything is there for it to begin.
    Ready,
    /// It was broken off, or is cleared away.
    Gone,
    /// Nobody can know from here.
    Elsewhere,
}

impl CalculationHandle {
    /// From what the store has; none for what nobody understands.
    pub fn parse(text: &str) -> Option<Self> {
        serde_json::from_str(text).ok()
    }

    /// As the store keeps it.
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

    /// Waits for the end; `None` if it was broken off.
    pub async fn wait(&self, slurm: &Slurm) -> Result<Option<CalculationEnd>, StoreError> {
        match self {
            Self::Local(calculation) => Ok(calculation.wait().await),
            Self::Slurm(job) => slurm.wait(job).await,
        }
    }

    /// Ends whatever is left of it, and removes its directory.
    pub async fn clear(&self, slurm: &Slurm) -> Result<(), StoreError> {
        if let Self::Slurm(job) = self {
            slurm.cancel(job).await?;
        }
        self.clone().remove().await
    }

    /// Removes the directory of one that has ended.
    pub async fn remove(self) -> Result<(), StoreError> {
        let directory = self.directory().to_owned();
        let removed = blocking(move || match self {
            Self::Local(calculation) => calculation.clear(),
            // What a node has not let go of yet is cleared away later.
            Self::Slurm(job) => {
                local::remove(&job.directory);
                Ok(())
            }
        });
        removed.await.map_err(|error| file(&directory, error))
    }
}
