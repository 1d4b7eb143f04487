//! Stopping the jobs of a campaign in order: agents deliver their reports to the orchestrator, which stops last.

use std::time::{Duration, Instant};

use ::slurm::{JobPhase, SlurmError};
use tokio::time::sleep;

use super::commands::SlurmCommands;
use super::job::{JobNames, Role, SlurmJob};

/// Interval between checks of stopping jobs.
const POLL_INTERVAL: Duration = Duration::from_secs(1);
/// Timeout for jobs to end. Slurm kills jobs that do not exit (`KillWait`, 30 s by default); jobs on a lost node remain
/// longer and are not waited for.
const STOP_TIMEOUT: Duration = Duration::from_secs(90);

impl SlurmCommands {
    /// Cancels agents and labellers, waits until they have ended, and then cancels the orchestrator, except for the job
    /// of the caller. Returns the number of cancelled jobs.
    pub async fn stop(&self, names: &JobNames, own: Option<u64>) -> Result<usize, SlurmError> {
        let begun = Instant::now();
        let mut ended = std::collections::BTreeSet::new();
        loop {
            let jobs = self.jobs(names).await?;
            let (leading, working): (Vec<_>, Vec<_>) = jobs
                .iter()
                .filter(|job| job.phase() != JobPhase::Over && Some(job.id) != own)
                .partition(|job| job.role == Role::Orchestrator);
            let last = working.is_empty() || begun.elapsed() > STOP_TIMEOUT;
            let now = if last { leading } else { working };
            // A job that was about to be requeued is pending again.
            let asked: Vec<_> = now.iter().filter(|job| is_active(job)).map(|job| job.id).collect();
            self.cancel(&asked).await?;
            ended.extend(asked);
            if now.is_empty() || begun.elapsed() > 2 * STOP_TIMEOUT {
                return Ok(ended.len());
            }
            sleep(POLL_INTERVAL).await;
        }
    }

    /// Cancels the pending jobs.
    pub async fn withdraw(&self, names: &JobNames) -> Result<usize, SlurmError> {
        let jobs = self.jobs(names).await?;
        let waiting = jobs.iter().filter(|job| job.phase() == JobPhase::Pending);
        let ids: Vec<_> = waiting.map(|job| job.id).collect();
        self.cancel(&ids).await?;
        Ok(ids.len())
    }
}

/// Whether it has not been asked to end, or was requeued.
fn is_active(job: &SlurmJob) -> bool {
    job.phase() != JobPhase::Completing
}
