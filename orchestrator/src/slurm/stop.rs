//! Ending the jobs of a campaign in order: agents deliver what they have to the orchestrator, which goes last.

use std::time::{Duration, Instant};

use ::slurm::{Phase, SlurmError};
use tokio::time::sleep;

use super::commands::Slurm;
use super::job::{Job, JobNames, Role};

/// Between two looks at jobs that are ending.
const POLL_INTERVAL: Duration = Duration::from_secs(1);
/// What does not end by itself is killed by Slurm (`KillWait`, 30 s by default); one whose node is lost stays for longer,
/// and is not waited for.
const STOP_TIMEOUT: Duration = Duration::from_secs(90);

impl Slurm {
    /// Ends agents and labellers, and when they are gone the orchestrator, but for the job that this is called from.
    /// Returns how many jobs there were.
    pub async fn stop(&self, names: &JobNames, own: Option<u64>) -> Result<usize, SlurmError> {
        let begun = Instant::now();
        let mut ended = std::collections::BTreeSet::new();
        loop {
            let jobs = self.jobs(names).await?;
            let (leading, working): (Vec<_>, Vec<_>) = jobs
                .iter()
                .filter(|job| job.phase() != Phase::Over && Some(job.id) != own)
                .partition(|job| job.role == Role::Orchestrator);
            let last = working.is_empty() || begun.elapsed() > STOP_TIMEOUT;
            let now = if last { leading } else { working };
            // One that was about to be requeued waits again now.
            let asked: Vec<_> = now.iter().filter(|job| is_active(job)).map(|job| job.id).collect();
            self.cancel(&asked).await?;
            ended.extend(asked);
            if now.is_empty() || begun.elapsed() > 2 * STOP_TIMEOUT {
                return Ok(ended.len());
            }
            sleep(POLL_INTERVAL).await;
        }
    }

    /// Takes away the jobs that have not begun.
    pub async fn withdraw(&self, names: &JobNames) -> Result<usize, SlurmError> {
        let jobs = self.jobs(names).await?;
        let waiting = jobs.iter().filter(|job| job.phase() == Phase::Pending);
        let ids: Vec<_> = waiting.map(|job| job.id).collect();
        self.cancel(&ids).await?;
        Ok(ids.len())
    }
}

/// Whether it has not been asked to end, or was and is requeued.
fn is_active(job: &Job) -> bool {
    job.phase() != Phase::Completing
}
