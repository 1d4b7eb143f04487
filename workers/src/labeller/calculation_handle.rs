//! Handles of calculations, wherever they run.

use std::path::Path;

use serde::{Deserialize, Serialize};
use store::StoreError;

use super::batch_access::BatchAccess;
use super::blocking::blocking;
use super::calculation_runner::CalculationEnd;
use super::calculation_state::CalculationState;
use super::custom_jobs::{self, CustomJob};
use super::file_error::file_error;
use super::local::{self, LocalCalculation};
use super::slurm::CalculationJob;

/// Identifies a calculation.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub(super) enum CalculationHandle {
    /// A process on a host.
    Local(LocalCalculation),
    /// A Slurm job on a cluster.
    Slurm(CalculationJob),
    /// A job of another batch system.
    Custom(CustomJob),
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
            Self::Custom(job) => &job.directory,
        }
    }

    pub async fn inspect(&self, batch: &BatchAccess) -> Result<CalculationState, StoreError> {
        match self {
            Self::Local(calculation) => Ok(calculation.inspect()),
            Self::Slurm(job) => batch.slurm.inspect(job).await,
            Self::Custom(job) => match &batch.custom {
                Some(custom) => custom.inspect(job).await,
                // The configuration has another batch system now.
                None => Ok(custom_jobs::poll_directory(job).unwrap_or(CalculationState::Elsewhere)),
            },
        }
    }

    /// Waits for its end; `None` if it was interrupted.
    pub async fn wait(&self, batch: &BatchAccess) -> Result<Option<CalculationEnd>, StoreError> {
        match self {
            Self::Local(calculation) => Ok(calculation.wait().await),
            Self::Slurm(job) => batch.slurm.wait(job).await,
            Self::Custom(job) => match &batch.custom {
                Some(custom) => custom.wait(job).await,
                None => Ok(CalculationEnd::read(&job.directory)),
            },
        }
    }

    /// Submits the job of a calculation that is ready to start.
    pub async fn submit(&self, batch: &BatchAccess) -> Result<(), StoreError> {
        match (self, &batch.custom) {
            (Self::Slurm(job), _) => batch.slurm.submit(job).await,
            (Self::Custom(job), Some(custom)) => custom.submit(job).await,
            (Self::Custom(_), None) | (Self::Local(_), _) => Ok(()),
        }
    }

    /// Ends what is left of it and removes its directory.
    pub async fn clear(&self, batch: &BatchAccess) -> Result<(), StoreError> {
        match (self, &batch.custom) {
            (Self::Slurm(job), _) => batch.slurm.cancel(job).await?,
            (Self::Custom(job), Some(custom)) => custom.cancel(job).await?,
            (Self::Custom(_), None) | (Self::Local(_), _) => {}
        }
        self.clone().remove().await
    }

    /// Removes the directory of a calculation that has ended.
    pub async fn remove(self) -> Result<(), StoreError> {
        let directory = self.directory().to_owned();
        let removed = blocking(move || match self {
            Self::Local(calculation) => calculation.clear(),
            // What a node still uses is removed later.
            Self::Slurm(CalculationJob { directory, .. }) | Self::Custom(CustomJob { directory, .. }) => {
                local::remove(&directory);
                Ok(())
            }
        });
        removed.await.map_err(|error| file_error(&directory, error))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_handle_is_read_as_what_it_was_written() {
        let directory = std::path::PathBuf::from("/scratch/1-1");
        let local = LocalCalculation {
            host: "head".to_owned(),
            directory: directory.clone(),
            pid: 7,
            start_time: "1".to_owned(),
        };
        let slurm = CalculationJob {
            cluster: "c".to_owned(),
            directory: directory.clone(),
            name: "calmwalk-1".to_owned(),
            user: Some(1),
            node: None,
        };
        let custom = CustomJob { scheduler: "PBS".to_owned(), directory, user: 1, time_limit: 60 };
        for handle in [
            CalculationHandle::Local(local),
            CalculationHandle::Slurm(slurm),
            CalculationHandle::Custom(custom),
        ] {
            assert_eq!(CalculationHandle::parse(&handle.identity()), Some(handle));
        }
    }
}
