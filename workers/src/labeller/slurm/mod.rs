//! A calculation as a Slurm job.
//!
//! Its directory, which every node sees, contains everything it needs: a labeller that finds the directory, and
//! that Slurm does not know the job's name, submits it (again). Of two jobs with the same name the second waits for
//! the end of the first (`singleton`), and only the one that creates the directory [`BEGUN`] calculates. A job
//! submitted twice because a reply was lost is therefore calculated once.
//!
//! The runner records the end, as for local calculations. Slurm is queried rarely, only to find jobs that can no
//! longer record their end; while it does not respond, nothing is concluded. It knows every unfinished job and
//! forgets finished ones after a while (`MinJobAge`): a job that it does not know is finished, and the job's log
//! gives the reason if Slurm ended it.

mod inspection;
mod job;
mod script;
mod squeue;
mod squeue_cache;
mod submission;

use std::ffi::OsStr;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use ::batch::{SlurmClient, SlurmError};
use dft::PassedEnvironment;
use store::StoreError;
use tokio::sync::OnceCell;
use tokio::time::sleep;
use tracing::{info, warn};

use super::batch_job::{
    CANCEL_TIMEOUT, COMMAND_TIMEOUT, MAX_POLL_INTERVAL, MIN_POLL_INTERVAL, RETRY_INTERVAL, own_user, settle,
};
use super::calculation_runner::CalculationEnd;
use super::calculation_state::{CalculationState, WaitStep};
use super::file_error::file_error;
use squeue_cache::SQUEUE_INTERVAL;

pub use inspection::{Inspection, InspectionStep, JobDirectory};
pub(super) use job::CalculationJob;
pub(super) use script::{JobRequirements, runner, write};
pub use squeue::{SqueueJob, Traces, infer_end, jobs_to_cancel};
pub use squeue_cache::is_listed;
pub(super) use squeue_cache::remove_cache;
pub use submission::{SubmissionRetry, SubmissionStep};

/// Access to Slurm for calculations.
pub(super) struct Slurm {
    commands: SlurmClient,
    cluster: OnceCell<String>,
    /// Whether Slurm accepts no further jobs, and that was logged.
    is_full: AtomicBool,
}

impl Slurm {
    /// Slurm's commands, with the variables that programs get: `sbatch` passes its environment to the job.
    pub fn new(passed: &PassedEnvironment) -> Self {
        let is_slurm_variable = |name: &OsStr| {
            let name = name.to_string_lossy();
            name.starts_with("SBATCH_") || name == "SLURM_JWT"
        };
        let own = std::env::vars_os().filter(|(name, _)| is_slurm_variable(name));
        let environment = passed.from_current_process().chain(own).collect();
        let commands = SlurmClient::with_timeout(COMMAND_TIMEOUT).with_environment(environment);
        Self { commands, cluster: OnceCell::new(), is_full: AtomicBool::new(false) }
    }

    /// The job of the calculation in this directory, which is below its campaign's.
    pub async fn job(&self, directory: &Path) -> Result<CalculationJob, StoreError> {
        let last = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let campaign = directory.parent().map(last).filter(|name| name.starts_with("calmwalk-"));
        let name = campaign.into_iter().chain([last(directory)]).collect::<Vec<_>>().join("-");
        let cluster = self.cluster(directory).await?.to_owned();
        Ok(CalculationJob {
            cluster,
            directory: directory.to_owned(),
            name,
            user: Some(own_user()),
            node: None,
        })
    }

    /// Submits a job that Slurm does not know. Waits while Slurm accepts no further job. If the reply is lost, looks for
    /// the job. If Slurm responds but refuses the job, the labeller fails, not the calculation.
    pub async fn submit(&self, job: &CalculationJob) -> Result<(), StoreError> {
        let mut submission = SubmissionRetry::default();
        loop {
            let on_full = |full: &SlurmError| {
                if !self.is_full.swap(true, Ordering::Relaxed) {
                    warn!("{full}: labels wait until it does");
                }
            };
            let submitted = self.commands.submit(&script::arguments(job), on_full).await;
            if self.is_full.swap(false, Ordering::Relaxed) {
                info!("Slurm accepts jobs again");
            }
            let Err(error) = submitted else { return Ok(()) };
            let (jobs, exists) = (self.jobs(job).await?, job.directory.is_dir());
            let permit = || script::clear_excluded_nodes(&job.directory);
            let step = submission.failed(&jobs, exists, permit);
            match step.map_err(|error| file_error(&job.directory, error))? {
                SubmissionStep::Wait => return Ok(()),
                SubmissionStep::Again => sleep(RETRY_INTERVAL).await,
                SubmissionStep::Refused => {
                    return Err(job_error(job, format_args!("cannot submit its job: {error}")));
                }
            }
        }
    }

    pub async fn inspect(&self, job: &CalculationJob) -> Result<CalculationState, StoreError> {
        let mut inspection = Inspection::default();
        let mut step = inspection.looked(JobDirectory::look(&job.directory));
        loop {
            step = match step {
                InspectionStep::Ask => {
                    if self.is_elsewhere(job).await? {
                        return Ok(CalculationState::Elsewhere);
                    }
                    inspection.answered(self.jobs(job).await?)
                }
                InspectionStep::Settle => {
                    settle(&job.directory).await;
                    inspection.looked(JobDirectory::look(&job.directory))
                }
                InspectionStep::InferEnd(reported) => {
                    let end = infer_end(reported.as_ref(), &Traces::read(&job.directory));
                    end.write(&job.directory).map_err(|error| file_error(&job.directory, error))?;
                    return Ok(CalculationState::Ended(end));
                }
                InspectionStep::Is(state) => return Ok(state),
                InspectionStep::NotVisible(why) => return Err(job_error(job, why)),
            };
        }
    }

    /// Whether Slurm does not show the job here: it is another user's, or on another cluster.
    async fn is_elsewhere(&self, job: &CalculationJob) -> Result<bool, StoreError> {
        let others = job.user.is_some_and(|user| user != own_user());
        Ok(others || self.cluster(&job.directory).await? != job.cluster)
    }

    /// Waits for the end, and submits the job if Slurm does not know it; `None` if its directory was removed.
    pub async fn wait(&self, job: &CalculationJob) -> Result<Option<CalculationEnd>, StoreError> {
        let (mut pause, mut asked) = (MIN_POLL_INTERVAL, Instant::now());
        loop {
            if let Some(end) = CalculationEnd::read(&job.directory) {
                return Ok(Some(end));
            }
            if asked.elapsed() >= SQUEUE_INTERVAL {
                if !squeue_cache::is_alive(&self.commands, job).await {
                    match self.inspect(job).await?.while_waiting() {
                        WaitStep::Read(end) => return Ok(Some(end)),
                        WaitStep::Submit => self.submit(job).await?,
                        WaitStep::Wait => {}
                        WaitStep::Abandon => return Ok(None),
                    }
                }
                asked = Instant::now();
            }
            sleep(pause).await;
            pause = (pause * 5 / 4).min(MAX_POLL_INTERVAL);
        }
    }

    /// Cancels a job and waits briefly for its end. If Slurm does not respond, this fails: the job continues, and
    /// a later labeller finds it.
    pub async fn cancel(&self, job: &CalculationJob) -> Result<(), StoreError> {
        let started = Instant::now();
        loop {
            let jobs = self.ask(job).await.map_err(|error| job_error(job, error))?;
            self.commands.cancel(&jobs_to_cancel(&jobs)).await.map_err(|error| job_error(job, error))?;
            if jobs.iter().all(SqueueJob::is_over) || started.elapsed() > CANCEL_TIMEOUT {
                return Ok(());
            }
            sleep(MIN_POLL_INTERVAL * 4).await;
        }
    }

    /// Queries the job, and retries until Slurm responds.
    async fn jobs(&self, job: &CalculationJob) -> Result<Vec<SqueueJob>, StoreError> {
        loop {
            match self.ask(job).await {
                Ok(jobs) => return Ok(jobs),
                Err(error) if error.is_missing() => return Err(job_error(job, error)),
                Err(_) => sleep(SQUEUE_INTERVAL).await,
            }
        }
    }

    async fn ask(&self, job: &CalculationJob) -> Result<Vec<SqueueJob>, SlurmError> {
        let name = format!("--name={}", job.name);
        let text = self.commands.queue(SqueueJob::FORMAT, &["--states=all", &name]).await?;
        SqueueJob::parse_all(&text)
    }

    async fn cluster(&self, directory: &Path) -> Result<&str, StoreError> {
        let ask = async || loop {
            match self.commands.cluster_name().await {
                Err(error) if error.is_missing() => {
                    return Err(file_error(directory, io::Error::other(error.to_string())));
                }
                Err(_) => sleep(RETRY_INTERVAL).await,
                Ok(cluster) => return Ok(cluster),
            }
        };
        self.cluster.get_or_try_init(ask).await.map(String::as_str)
    }
}

fn job_error(job: &CalculationJob, why: impl ToString) -> StoreError {
    file_error(&job.directory, io::Error::other(why.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn jobs_of_another_user_are_ignored() {
        let directory = tempfile::tempdir().unwrap();
        let job = CalculationJob {
            cluster: "any".to_owned(),
            directory: directory.path().to_owned(),
            name: "calmwalk-1".to_owned(),
            user: Some(own_user() + 1),
            node: None,
        };
        assert_eq!(
            Slurm::new(&PassedEnvironment::default()).inspect(&job).await.unwrap(),
            CalculationState::Elsewhere
        );
    }
}
