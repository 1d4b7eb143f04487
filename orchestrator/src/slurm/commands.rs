//! Slurm's own commands, asked and told as child processes.

use std::ffi::{OsStr, OsString};
use std::io;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use tokio::process::Command;

use super::job::{Job, JobNames, Role, comment};
use super::plan::Submission;

/// Jobs in one call of `scancel`.
const AT_ONCE: usize = 200;

/// Slurm, as far as this host can reach it.
#[derive(Clone, Debug)]
pub struct Slurm {
    patience: Duration,
}

/// Everything about a submission that is the same for all jobs of a kind.
#[derive(Clone, Debug)]
pub struct Request<'a> {
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

/// Why Slurm did not do what it was asked for.
#[derive(Debug, thiserror::Error)]
pub enum SlurmError {
    /// There is no such command.
    #[error("cannot start {program}: {source}; Slurm's commands have to be on the PATH")]
    Missing {
        /// The command.
        program: &'static str,
        /// Why not.
        source: io::Error,
    },
    /// It takes too long.
    #[error("{program} has given no answer for {seconds} s: is slurmctld at work? ('scontrol ping' says so)")]
    Silent {
        /// The command.
        program: &'static str,
        /// How long.
        seconds: u64,
    },
    /// It has failed.
    #[error("{program} failed: {said}")]
    Failed {
        /// The command.
        program: &'static str,
        /// What it wrote.
        said: String,
    },
    /// It says something else than what it was asked for.
    #[error("{program} wrote {found:?}, and {expected} was expected")]
    Unreadable {
        /// The command.
        program: &'static str,
        /// What it wrote.
        found: String,
        /// What it should have written.
        expected: &'static str,
    },
}

impl SlurmError {
    /// Whether there is no Slurm here at all.
    pub fn is_missing(&self) -> bool {
        matches!(self, Self::Missing { source, .. } if source.kind() == io::ErrorKind::NotFound)
    }
}

impl Slurm {
    /// Who does not wait for an answer for longer than this.
    pub fn with_patience(patience: Duration) -> Self {
        Self { patience }
    }

    /// The jobs of a campaign that this user has: all that wait or run, and those that have ended within the last minutes
    /// (`MinJobAge` in Slurm's configuration).
    pub async fn jobs(&self, names: &JobNames) -> Result<Vec<Job>, SlurmError> {
        const SQUEUE: &str = "squeue";
        let user = rustix::process::getuid().as_raw();
        let arguments =
            ["--noheader", "--states=all", "--array", &format!("--user={user}"), "--format", Job::FORMAT];
        let text = self.ask(SQUEUE, arguments).await?;
        let job = |line: &str| {
            let expected = "what --format asks for";
            let unreadable =
                |()| SlurmError::Unreadable { program: SQUEUE, found: line.to_owned(), expected };
            Job::parse(line, names).map_err(unreadable).transpose()
        };
        text.lines().filter_map(job).collect()
    }

    /// The exit code of a job that has ended as `code:signal`, while Slurm still knows it.
    pub async fn exit_code(&self, id: u64) -> Result<Option<String>, SlurmError> {
        let text = self.ask("scontrol", ["--oneliner", "show", "job", &id.to_string()]).await?;
        let code = text.split_whitespace().find_map(|word| word.strip_prefix("ExitCode="));
        Ok(code.map(str::to_owned))
    }

    /// Submits a job and returns its number.
    pub async fn submit(
        &self,
        names: &JobNames,
        submission: &Submission,
        request: &Request<'_>,
    ) -> Result<u64, SlurmError> {
        const SBATCH: &str = "sbatch";
        let text = self.ask(SBATCH, request.arguments(names, submission)).await?;
        // With several clusters its name follows.
        let id = text.trim().split(';').next().and_then(|id| id.parse().ok());
        let expected = "the number of a job";
        id.ok_or_else(|| SlurmError::Unreadable { program: SBATCH, found: text.trim().to_owned(), expected })
    }

    /// Has jobs ended: each process of theirs gets SIGTERM, and SIGKILL after Slurm's `KillWait`. Those that have ended
    /// are no error.
    pub async fn cancel(&self, ids: &[u64]) -> Result<(), SlurmError> {
        for ids in ids.chunks(AT_ONCE) {
            let ids = ids.iter().map(u64::to_string);
            self.ask("scancel", ["--quiet".to_owned()].into_iter().chain(ids)).await?;
        }
        Ok(())
    }

    /// What a command writes to its standard output.
    async fn ask(
        &self,
        program: &'static str,
        arguments: impl IntoIterator<Item = impl AsRef<OsStr>>,
    ) -> Result<String, SlurmError> {
        let mut command = Command::new(program);
        command.args(arguments).stdin(Stdio::null()).kill_on_drop(true);
        // Habits of the user that would show something else than is expected.
        for (name, _) in std::env::vars_os() {
            let text = name.to_string_lossy();
            if text.starts_with("SQUEUE_") || text.starts_with("SCANCEL_") {
                command.env_remove(&name);
            }
        }
        command.env("SLURM_TIME_FORMAT", "standard");
        let silent = |_| SlurmError::Silent { program, seconds: self.patience.as_secs() };
        let output = tokio::time::timeout(self.patience, command.output()).await.map_err(silent)?;
        let output = output.map_err(|source| SlurmError::Missing { program, source })?;
        if !output.status.success() {
            let said = String::from_utf8_lossy(&output.stderr).trim().to_owned();
            let said = if said.is_empty() { output.status.to_string() } else { said };
            return Err(SlurmError::Failed { program, said });
        }
        Ok(String::from_utf8_lossy(&output.stdout).into_owned())
    }
}

impl Request<'_> {
    /// What `sbatch` is called with. Options on the command line go before those of the script.
    pub fn arguments(&self, names: &JobNames, submission: &Submission) -> Vec<OsString> {
        let role = submission.role;
        let mut dependency = vec!["singleton".to_owned()];
        dependency.extend(submission.after_end_of.iter().map(|id| format!("afterany:{id}")));
        if let Some(id) = self.orchestrator.filter(|_| role != Role::Orchestrator) {
            dependency.push(format!("after:{id}"));
        }
        let mut arguments: Vec<OsString> = self.options.iter().map(Into::into).collect();
        arguments.push("--parsable".into());
        arguments.push(format!("--job-name={}", names.of(role)).into());
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
