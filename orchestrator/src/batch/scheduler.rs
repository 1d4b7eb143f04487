//! The batch systems of a campaign behind one interface.

use std::fmt::Display;

use ::batch::JobId;

use super::custom_commands::CustomCommands;
use super::error::BatchError;
use super::job::{CampaignJob, JobNames};
use super::plan::Submission;
use super::slurm_commands::{JobOptions, SlurmCommands};

/// The batch system of a campaign's jobs.
#[derive(Clone, Debug)]
pub enum BatchScheduler {
    /// Slurm.
    Slurm(SlurmCommands),
    /// The one that the configuration describes.
    Custom(Box<CustomCommands>),
}

impl BatchScheduler {
    /// The jobs of a campaign: all pending and running ones, and some of those that have ended.
    ///
    /// # Errors
    /// See [`BatchError`], also for the following functions.
    pub async fn jobs(&self, names: &JobNames) -> Result<Vec<CampaignJob>, BatchError> {
        match self {
            Self::Slurm(commands) => Ok(commands.jobs(names).await?),
            Self::Custom(commands) => commands.jobs(names).await,
        }
    }

    /// Exit code of an ended job as `code:signal`, if the batch system knows it.
    pub async fn exit_code(&self, id: &JobId) -> Result<Option<String>, BatchError> {
        match self {
            Self::Slurm(commands) => Ok(commands.exit_code(id).await?),
            Self::Custom(_) => Ok(None),
        }
    }

    /// Submits a job and returns its id. Waits while the batch system accepts no further job, and calls `on_full` when it starts
    /// to wait.
    pub async fn submit(
        &self,
        names: &JobNames,
        submission: &Submission,
        request: &JobOptions<'_>,
        on_full: impl FnOnce(&dyn Display),
    ) -> Result<JobId, BatchError> {
        match self {
            Self::Slurm(commands) => {
                Ok(commands.submit(names, submission, request, |full| on_full(full)).await?)
            }
            Self::Custom(commands) => commands.submit(names, submission, request, |full| on_full(full)).await,
        }
    }

    /// Cancels jobs: their processes get SIGTERM, and SIGKILL some time later. Jobs that have ended are not an error.
    pub async fn cancel(&self, ids: &[JobId]) -> Result<(), BatchError> {
        match self {
            Self::Slurm(commands) => Ok(commands.cancel(ids).await?),
            Self::Custom(commands) => commands.cancel(ids).await,
        }
    }

    /// The job in which this process runs.
    pub fn own_job(&self, names: &JobNames) -> Option<JobId> {
        match self {
            Self::Slurm(_) => JobId::at_start_of(&std::env::var("SLURM_JOB_ID").ok()?),
            Self::Custom(commands) => commands.own_job(names),
        }
    }
}
