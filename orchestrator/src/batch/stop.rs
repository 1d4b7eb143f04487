//! Stopping the jobs of a campaign in order: agents deliver their reports to the orchestrator, which stops last.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use ::batch::{JobId, JobPhase};
use tokio::time::sleep;

use super::error::BatchError;
use super::job::{CampaignJob, JobNames, Role};
use super::scheduler::BatchScheduler;

/// Interval between checks of stopping jobs.
const POLL_INTERVAL: Duration = Duration::from_secs(1);
/// Timeout for jobs to end. Slurm kills jobs that do not exit (`KillWait`, 30 s by default); jobs on a lost node remain
/// longer and are not waited for.
const STOP_TIMEOUT: Duration = Duration::from_secs(90);

impl BatchScheduler {
    /// Cancels agents and labellers, waits until they have ended, and then cancels the orchestrator, except for the job
    /// of the caller. Returns the number of cancelled jobs.
    pub async fn stop(&self, names: &JobNames, own: Option<JobId>) -> Result<usize, BatchError> {
        let begun = Instant::now();
        let mut ended = BTreeSet::new();
        loop {
            let jobs = self.jobs(names).await?;
            let (leading, working): (Vec<_>, Vec<_>) = jobs
                .iter()
                .filter(|job| job.phase() != JobPhase::Over && Some(&job.id) != own.as_ref())
                .partition(|job| job.role == Role::Orchestrator);
            let last = working.is_empty() || begun.elapsed() > STOP_TIMEOUT;
            let now = if last { leading } else { working };
            let asked = now.iter().filter(|job| self.may_be_asked(job, &ended)).map(|job| job.id.clone());
            let asked: Vec<_> = asked.collect();
            self.cancel(&asked).await?;
            ended.extend(asked);
            if now.is_empty() || begun.elapsed() > 2 * STOP_TIMEOUT {
                return Ok(ended.len());
            }
            sleep(POLL_INTERVAL).await;
        }
    }

    /// Cancels the pending jobs.
    pub async fn withdraw(&self, names: &JobNames) -> Result<usize, BatchError> {
        let jobs = self.jobs(names).await?;
        let waiting = jobs.iter().filter(|job| job.phase() == JobPhase::Pending);
        let ids: Vec<_> = waiting.map(|job| job.id.clone()).collect();
        self.cancel(&ids).await?;
        Ok(ids.len())
    }

    /// Whether a job has not been asked to end, or was requeued: in Slurm, a job that was about to be requeued is pending again.
    /// A custom batch system does not say that a job is ending.
    fn may_be_asked(&self, job: &CampaignJob, asked: &BTreeSet<JobId>) -> bool {
        match self {
            Self::Slurm(_) => job.phase() != JobPhase::Completing,
            Self::Custom(_) => !asked.contains(&job.id),
        }
    }
}
