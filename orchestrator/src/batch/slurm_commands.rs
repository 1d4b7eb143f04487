//! The jobs of a campaign, through Slurm's commands.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::time::Duration;

use ::batch::{JobId, SlurmClient, SlurmError};

use super::job::{CampaignJob, JobNames, Role, comment};
use super::plan::Submission;

/// Slurm's commands on this host.
#[derive(Clone, Debug)]
pub struct SlurmCommands {
    commands: SlurmClient,
}

/// Options of a submission that are the same for all jobs of a kind.
#[derive(Clone, Debug)]
pub struct JobOptions<'a> {
    /// Job script. A custom batch system needs no more than this, the walkers and the orchestrator's job.
    pub script: PathBuf,
    /// File for its output.
    pub log: PathBuf,
    /// Working directory.
    pub directory: &'a Path,
    /// Number of walkers of an agent.
    pub walkers: u32,
    /// Job of the orchestrator; agents and labellers start after it.
    pub orchestrator: Option<JobId>,
    /// Additional options of `sbatch`.
    pub options: &'a [String],
}

impl SlurmCommands {
    /// With a timeout for each command.
    pub fn with_timeout(timeout: Duration) -> Self {
        Self { commands: SlurmClient::with_timeout(timeout) }
    }

    /// The jobs of a campaign that belong to this user: all pending and running ones, and those that ended within the
    /// last minutes (`MinJobAge` in Slurm's configuration).
    pub async fn jobs(&self, names: &JobNames) -> Result<Vec<CampaignJob>, SlurmError> {
        let text = self.commands.queue(CampaignJob::FORMAT, &["--states=all"]).await?;
        let job = |line: &str| {
            let (found, expected) = (line.to_owned(), "what --format asks for");
            let unreadable = |()| SlurmError::UnexpectedOutput { program: "squeue", found, expected };
            CampaignJob::parse(line, names).map_err(unreadable).transpose()
        };
        text.lines().filter_map(job).collect()
    }

    /// Exit code of an ended job as `code:signal`, while Slurm still knows it.
    pub async fn exit_code(&self, id: &JobId) -> Result<Option<String>, SlurmError> {
        self.commands.exit_code(id).await
    }

    /// Submits a job and returns its id. Waits while Slurm accepts no further job, and calls `on_full` when it starts to
    /// wait.
    pub async fn submit(
        &self,
        names: &JobNames,
        submission: &Submission,
        request: &JobOptions<'_>,
        on_full: impl FnOnce(&SlurmError),
    ) -> Result<JobId, SlurmError> {
        self.commands.submit(&request.arguments(names, submission), on_full).await
    }

    /// Cancels jobs: each of their processes gets SIGTERM, and SIGKILL after Slurm's `KillWait`. Jobs that have already
    /// ended are not an error.
    pub async fn cancel(&self, ids: &[JobId]) -> Result<(), SlurmError> {
        self.commands.cancel(ids).await
    }
}

impl JobOptions<'_> {
    /// Arguments of `sbatch`. Options on the command line take precedence over those in the script.
    pub fn arguments(&self, names: &JobNames, submission: &Submission) -> Vec<OsString> {
        let role = submission.role;
        let mut dependency = vec!["singleton".to_owned()];
        dependency.extend(submission.after_end_of.iter().map(|id| format!("afterany:{id}")));
        if let Some(id) = self.orchestrator.as_ref().filter(|_| role != Role::Orchestrator) {
            dependency.push(format!("after:{id}"));
        }
        let mut arguments: Vec<OsString> = self.options.iter().map(Into::into).collect();
        arguments.push(format!("--job-name={}", names.job_name(role)).into());
        arguments.push(format!("--dependency={}", dependency.join(",")).into());
        if let Role::Agent(_) = role {
            arguments.push(format!("--comment={}", comment(self.walkers)).into());
        }
        arguments.push(with("--chdir=", self.directory.as_os_str()));
        // sbatch replaces letters after '%' by numbers of the job.
        arguments.push(format!("--output={}", self.log.display().to_string().replace('%', "%%")).into());
        arguments.push(self.script.clone().into());
        arguments
    }
}

fn with(option: &str, value: &OsStr) -> OsString {
    let mut whole = OsString::from(option);
    whole.push(value);
    whole
}
