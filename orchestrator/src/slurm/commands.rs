//! The jobs of a campaign, as Slurm's own commands show and take them.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::time::Duration;

use ::slurm::{Commands, SlurmError};

use super::job::{Job, JobNames, Role, comment};
use super::plan::Submission;

/// Slurm, as far as this host can reach it.
#[derive(Clone, Debug)]
pub struct Slurm {
    commands: Commands,
}

/// Everything about a submission that is the same for all jobs of a kind.
#[derive(Clone, Debug)]
pub struct JobOptions<'a> {
    /// The job's script.
    pub script: PathBuf,
    /// What it says goes here.
    pub log: PathBuf,
    /// Where it begins.
    pub directory: &'a Path,
    /// Walkers, of an agent.
    pub walkers: u32,
    /// The job in which the orchestrator is, which agents and labellers follow.
    pub orchestrator: Option<u64>,
    /// Further options of `sbatch`.
    pub options: &'a [String],
}

impl Slurm {
    /// Who does not wait for an answer for longer than this.
    pub fn with_timeout(timeout: Duration) -> Self {
        Self { commands: Commands::with_patience(timeout) }
    }

    /// The jobs of a campaign that this user has: all that wait or run, and those that have ended within the last minutes
    /// (`MinJobAge` in Slurm's configuration).
    pub async fn jobs(&self, names: &JobNames) -> Result<Vec<Job>, SlurmError> {
        let text = self.commands.queue(Job::FORMAT, &["--states=all"]).await?;
        let job = |line: &str| {
            let (found, expected) = (line.to_owned(), "what --format asks for");
            let unreadable = |()| SlurmError::Unreadable { program: "squeue", found, expected };
            Job::parse(line, names).map_err(unreadable).transpose()
        };
        text.lines().filter_map(job).collect()
    }

    /// The exit code of a job that has ended as `code:signal`, while Slurm still knows it.
    pub async fn exit_code(&self, id: u64) -> Result<Option<String>, SlurmError> {
        self.commands.exit_code(id).await
    }

    /// Submits a job and returns its number.
    pub async fn submit(
        &self,
        names: &JobNames,
        submission: &Submission,
        request: &JobOptions<'_>,
    ) -> Result<u64, SlurmError> {
        self.commands.submit(&request.arguments(names, submission)).await
    }

    /// Has jobs ended: each process of theirs gets SIGTERM, and SIGKILL after Slurm's `KillWait`. Those that have ended
    /// are no error.
    pub async fn cancel(&self, ids: &[u64]) -> Result<(), SlurmError> {
        self.commands.cancel(ids).await
    }
}

impl JobOptions<'_> {
    /// What `sbatch` is called with. Options on the command line go before those of the script.
    pub fn arguments(&self, names: &JobNames, submission: &Submission) -> Vec<OsString> {
        let role = submission.role;
        let mut dependency = vec!["singleton".to_owned()];
        dependency.extend(submission.after_end_of.iter().map(|id| format!("afterany:{id}")));
        if let Some(id) = self.orchestrator.filter(|_| role != Role::Orchestrator) {
            dependency.push(format!("after:{id}"));
        }
        let mut arguments: Vec<OsString> = self.options.iter().map(Into::into).collect();
        arguments.push(format!("--job-name={}", names.job_name(role)).into());
        arguments.push(format!("--dependency={}", dependency.join(",")).into());
        if let Role::Agent(_) = role {
            arguments.push(format!("--comment={}", comment(self.walkers)).into());
        }
        arguments.push(with("--chdir=", self.directory.as_os_str()));
        // sbatch puts numbers of the job in the place of letters after '%'.
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
