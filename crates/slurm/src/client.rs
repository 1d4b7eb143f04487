//! Slurm's own commands, asked and told as child processes.

use std::ffi::{OsStr, OsString};
use std::io;
use std::process::Stdio;
use std::time::Duration;

use tokio::process::Command;

/// Jobs in one call of `scancel`.
const JOBS_PER_CANCEL: usize = 200;
/// Where Slurm is and who this is; all other variables of its name belong to a job that this process may be part of, and
/// would be taken for options of another.
const KEPT_VARIABLES: [&str; 3] = ["SLURM_CONF", "SLURM_CONF_SERVER", "SLURM_JWT"];

/// Slurm, as far as this host can reach it.
#[derive(Clone, Debug)]
pub struct SlurmClient {
    timeout: Duration,
    /// What they are started with instead of the environment of this process.
    environment: Option<Vec<(OsString, OsString)>>,
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
    TimedOut {
        /// The command.
        program: &'static str,
        /// How long.
        seconds: u64,
    },
    /// It has failed.
    #[error("{program} failed: {stderr}")]
    Failed {
        /// The command.
        program: &'static str,
        /// What it wrote.
        stderr: String,
    },
    /// It says something else than what it was asked for.
    #[error("{program} wrote {found:?}, and {expected} was expected")]
    UnexpectedOutput {
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

impl SlurmClient {
    /// Those that are not waited for for longer than this.
    pub fn with_timeout(timeout: Duration) -> Self {
        Self { timeout, environment: None }
    }

    /// The same, started with this environment and not with that of this process: jobs get it, too.
    pub fn with_environment(self, environment: Vec<(OsString, OsString)>) -> Self {
        Self { environment: Some(environment), ..self }
    }

    /// What `squeue` writes of this user's jobs, a line each, in this format. With `options` it may be asked for some of
    /// them, and for those that have ended within the last minutes (`MinJobAge` in Slurm's configuration).
    ///
    /// # Errors
    /// See [`SlurmError`]; as of all that follow.
    pub async fn queue(&self, format: &str, options: &[&str]) -> Result<String, SlurmError> {
        let user = format!("--user={}", rustix::process::getuid().as_raw());
        let arguments = ["--noheader", "--array", &user, "--format", format];
        self.run("squeue", arguments.iter().chain(options)).await
    }

    /// The exit code of a job that has ended as `code:signal`, while Slurm still knows it.
    pub async fn exit_code(&self, id: u64) -> Result<Option<String>, SlurmError> {
        let text = self.run("scontrol", ["--oneliner", "show", "job", &id.to_string()]).await?;
        let code = text.split_whitespace().find_map(|word| word.strip_prefix("ExitCode="));
        Ok(code.map(str::to_owned))
    }

    /// The name of the cluster; numbers and names of jobs mean nothing in another.
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

    /// Submits a job with these arguments of `sbatch` and returns its number.
    pub async fn submit(&self, arguments: &[impl AsRef<OsStr>]) -> Result<u64, SlurmError> {
        const SBATCH: &str = "sbatch";
        let arguments = arguments.iter().map(AsRef::as_ref);
        let text = self.run(SBATCH, [OsStr::new("--parsable")].into_iter().chain(arguments)).await?;
        // With several clusters its name follows.
        let id = text.trim().split(';').next().and_then(|id| id.parse().ok());
        let expected = "the number of a job";
        id.ok_or_else(|| SlurmError::UnexpectedOutput {
            program: SBATCH,
            found: text.trim().to_owned(),
            expected,
        })
    }

    /// Has jobs ended: each process of theirs gets SIGTERM, and SIGKILL after Slurm's `KillWait`. Those that have ended
    /// are no error.
    pub async fn cancel(&self, ids: &[u64]) -> Result<(), SlurmError> {
        for ids in ids.chunks(JOBS_PER_CANCEL) {
            let ids = ids.iter().map(u64::to_string);
            self.run("scancel", ["--quiet".to_owned()].into_iter().chain(ids)).await?;
        }
        Ok(())
    }

    /// What a command writes to its standard output.
    async fn run(
        &self,
        program: &'static str,
        arguments: impl IntoIterator<Item = impl AsRef<OsStr>>,
    ) -> Result<String, SlurmError> {
        let mut command = Command::new(program);
        command.args(arguments).stdin(Stdio::null()).kill_on_drop(true);
        // Habits of the user, too, would show something else than is expected.
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
        let timed_out = |_| SlurmError::TimedOut { program, seconds: self.timeout.as_secs() };
        let output = tokio::time::timeout(self.timeout, command.output()).await.map_err(timed_out)?;
        let output = output.map_err(|source| SlurmError::Missing { program, source })?;
        if !output.status.success() {
            let stderr = String::from_utf8_lossy(&output.stderr).trim().to_owned();
            let stderr = if stderr.is_empty() { output.status.to_string() } else { stderr };
            return Err(SlurmError::Failed { program, stderr });
        }
        Ok(String::from_utf8_lossy(&output.stdout).into_owned())
    }
}
