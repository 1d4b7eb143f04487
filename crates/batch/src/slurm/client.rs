//! Runs Slurm's commands as child processes.

use std::ffi::{OsStr, OsString};
use std::io;
use std::process::{Output, Stdio};
use std::time::Duration;

use tokio::process::Command;

use super::queue_full;
use crate::full_pause::FullPause;
use crate::job_id::JobId;

/// Maximum number of jobs per call of `scancel`.
const JOBS_PER_CANCEL: usize = 200;
/// Variables that locate Slurm and identify the user. All other Slurm variables belong to a job that this
/// process may be part of; commands would take them for options.
const KEPT_VARIABLES: [&str; 3] = ["SLURM_CONF", "SLURM_CONF_SERVER", "SLURM_JWT"];

/// Slurm, through its commands on this host.
#[derive(Clone, Debug)]
pub struct SlurmClient {
    timeout: Duration,
    /// Environment of the commands in place of the current process's.
    environment: Option<Vec<(OsString, OsString)>>,
}

/// Why a Slurm command failed.
#[derive(Debug, thiserror::Error)]
pub enum SlurmError {
    /// The command does not exist.
    #[error("cannot start {program}: {source}; Slurm's commands must be on the PATH")]
    Missing {
        /// The command.
        program: &'static str,
        /// The error of the operating system.
        source: io::Error,
    },
    /// It exceeded its time limit.
    #[error(
        "{program} did not answer within {seconds} s: is slurmctld running? (check with 'scontrol ping')"
    )]
    TimedOut {
        /// The command.
        program: &'static str,
        /// The limit.
        seconds: u64,
    },
    /// It failed.
    #[error("{program} failed: {stderr}")]
    Failed {
        /// The command.
        program: &'static str,
        /// Its message.
        stderr: String,
    },
    /// Slurm accepts no further job for now: its queue is full, or a limit on the number of jobs is reached.
    #[error("Slurm accepts no further jobs for now ({reason})")]
    Full {
        /// What `sbatch` said.
        reason: String,
    },
    /// Its output has an unexpected format.
    #[error("{program} wrote {found:?}, expected {expected}")]
    UnexpectedOutput {
        /// The command.
        program: &'static str,
        /// Its output.
        found: String,
        /// The expected output.
        expected: &'static str,
    },
}

impl SlurmError {
    /// Whether Slurm is not installed.
    pub fn is_missing(&self) -> bool {
        matches!(self, Self::Missing { source, .. } if source.kind() == io::ErrorKind::NotFound)
    }
}

impl SlurmClient {
    /// A client whose commands may take at most this time.
    pub fn with_timeout(timeout: Duration) -> Self {
        Self { timeout, environment: None }
    }

    /// Runs commands with this environment in place of the current process's. Jobs inherit it.
    pub fn with_environment(self, environment: Vec<(OsString, OsString)>) -> Self {
        Self { environment: Some(environment), ..self }
    }

    /// The output of `squeue` for this user's jobs in this format, one line per job. `options` can select jobs
    /// or include those that ended within the last minutes (`MinJobAge` in Slurm's configuration).
    ///
    /// # Errors
    /// See [`SlurmError`], also for the following functions.
    pub async fn queue(&self, format: &str, options: &[&str]) -> Result<String, SlurmError> {
        let user = format!("--user={}", rustix::process::getuid().as_raw());
        let arguments = ["--noheader", "--array", &user, "--format", format];
        self.run("squeue", arguments.iter().chain(options)).await
    }

    /// The exit code of a finished job as `code:signal`, while Slurm still knows the job.
    pub async fn exit_code(&self, id: &JobId) -> Result<Option<String>, SlurmError> {
        let text = self.run("scontrol", ["--oneliner", "show", "job", id.as_str()]).await?;
        let code = text.split_whitespace().find_map(|word| word.strip_prefix("ExitCode="));
        Ok(code.map(str::to_owned))
    }

    /// The name of the cluster. Ids and names of jobs are meaningless on another cluster.
    pub async fn cluster_name(&self) -> Result<String, SlurmError> {
        const SCONTROL: &str = "scontrol";
        let text = self.run(SCONTROL, ["show", "config"]).await?;
        let entries = text.lines().filter_map(|line| line.split_once('='));
        let name =
            entries.map(|(key, value)| (key.trim(), value.trim())).find(|(key, _)| *key == "ClusterName");
        let (_, name) = name.ok_or_else(|| SlurmError::UnexpectedOutput {
            program: SCONTROL,
            found: text.lines().next().unwrap_or_default().to_owned(),
            expected: "its configuration with the key ClusterName",
        })?;
        Ok(name.to_owned())
    }

    /// Submits a job with these arguments of `sbatch` and returns its id. Waits while Slurm accepts no further job,
    /// however long that takes, and calls `on_full` with the error when it starts to wait.
    pub async fn submit(
        &self,
        arguments: &[impl AsRef<OsStr>],
        on_full: impl FnOnce(&SlurmError),
    ) -> Result<JobId, SlurmError> {
        let (mut on_full, mut pause) = (Some(on_full), FullPause::new());
        loop {
            match self.try_submit(arguments).await {
                Err(full @ SlurmError::Full { .. }) => {
                    if let Some(on_full) = on_full.take() {
                        on_full(&full);
                    }
                }
                result => return result,
            }
            pause.wait().await;
        }
    }

    async fn try_submit(&self, arguments: &[impl AsRef<OsStr>]) -> Result<JobId, SlurmError> {
        const SBATCH: &str = "sbatch";
        let arguments = arguments.iter().map(AsRef::as_ref);
        let mut command = self.command(SBATCH, [OsStr::new("--parsable")].into_iter().chain(arguments));
        let full = |error| match error {
            SlurmError::Failed { program, stderr } => match queue_full::reason(&stderr) {
                Some(reason) => SlurmError::Full { reason },
                None => SlurmError::Failed { program, stderr },
            },
            error => error,
        };
        let text = self.answer(SBATCH, queue_full::submission(&mut command)).await.map_err(full)?;
        // With several clusters the name of the cluster follows.
        let id = text.trim().split(';').next().and_then(|id| id.parse::<u64>().ok()).map(JobId::from);
        let expected = "a job id";
        id.ok_or_else(|| SlurmError::UnexpectedOutput {
            program: SBATCH,
            found: text.trim().to_owned(),
            expected,
        })
    }

    /// Cancels jobs: their processes get SIGTERM, and SIGKILL after Slurm's `KillWait`. Ignores jobs that have
    /// ended.
    pub async fn cancel(&self, ids: &[JobId]) -> Result<(), SlurmError> {
        for ids in ids.chunks(JOBS_PER_CANCEL) {
            let ids = ids.iter().map(JobId::to_string);
            self.run("scancel", ["--quiet".to_owned()].into_iter().chain(ids)).await?;
        }
        Ok(())
    }

    /// The standard output of a command.
    async fn run(
        &self,
        program: &'static str,
        arguments: impl IntoIterator<Item = impl AsRef<OsStr>>,
    ) -> Result<String, SlurmError> {
        let mut command = self.command(program, arguments);
        self.answer(program, command.output()).await
    }

    /// A command without the user's own settings.
    fn command(
        &self,
        program: &'static str,
        arguments: impl IntoIterator<Item = impl AsRef<OsStr>>,
    ) -> Command {
        let mut command = Command::new(program);
        command.args(arguments).stdin(Stdio::null()).kill_on_drop(true);
        // The user's own settings would change the output format too.
        let inherited = self.environment.clone().unwrap_or_else(|| std::env::vars_os().collect());
        command.env_clear();
        for (name, value) in inherited {
            let text = name.to_string_lossy();
            let is_filtered = ["SQUEUE_", "SCANCEL_", "SLURM_", "SBATCH_CLUSTERS"]
                .iter()
                .any(|begin| text.starts_with(begin));
            if !is_filtered || KEPT_VARIABLES.contains(&text.as_ref()) {
                command.env(&name, value);
            }
        }
        command.env("SLURM_TIME_FORMAT", "standard");
        command
    }

    /// The standard output of a command, once it has ended well.
    async fn answer(
        &self,
        program: &'static str,
        output: impl Future<Output = io::Result<Output>>,
    ) -> Result<String, SlurmError> {
        let timed_out = |_| SlurmError::TimedOut { program, seconds: self.timeout.as_secs() };
        let output = tokio::time::timeout(self.timeout, output).await.map_err(timed_out)?;
        let output = output.map_err(|source| SlurmError::Missing { program, source })?;
        if !output.status.success() {
            let stderr = String::from_utf8_lossy(&output.stderr).trim().to_owned();
            let stderr = if stderr.is_empty() { output.status.to_string() } else { stderr };
            return Err(SlurmError::Failed { program, stderr });
        }
        Ok(String::from_utf8_lossy(&output.stdout).into_owned())
    }
}
