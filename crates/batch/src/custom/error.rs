//! Why a command of a custom batch system failed.

use std::io;
use std::path::PathBuf;

/// Why a command of a custom batch system failed.
#[derive(Debug, thiserror::Error)]
pub enum CustomError {
    /// No shell, or no file of the script.
    #[error("cannot start `{command}` ({key}): {source}")]
    NotStarted {
        /// Key of the configuration.
        key: &'static str,
        /// The command.
        command: String,
        /// The error of the operating system.
        source: io::Error,
    },
    /// It exceeded its time limit.
    #[error("`{command}` ({key}) did not answer within {seconds} s")]
    TimedOut {
        /// Key of the configuration.
        key: &'static str,
        /// The command.
        command: String,
        /// The limit.
        seconds: u64,
    },
    /// It failed.
    #[error("`{command}` ({key}) failed with {status}: {output}")]
    Failed {
        /// Key of the configuration.
        key: &'static str,
        /// The command.
        command: String,
        /// How it ended.
        status: std::process::ExitStatus,
        /// What it printed.
        output: String,
    },
    /// The batch system accepts no further job for now.
    #[error("{name} accepts no further jobs for now ({reason})")]
    Full {
        /// Name of the batch system.
        name: String,
        /// What the command said.
        reason: String,
    },
    /// Its output is not what the configuration says.
    #[error("`{command}` ({key}) printed {found:?}; expected {expected}")]
    UnexpectedOutput {
        /// Key of the configuration.
        key: &'static str,
        /// The command.
        command: String,
        /// What it printed.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// A command or script that cannot be filled.
    #[error("{key} is {found}; expected {expected}")]
    Template {
        /// Key of the configuration.
        key: &'static str,
        /// What was found.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// A script that cannot be read.
    #[error("cannot read the job script {}: {source}", path.display())]
    Script {
        /// The script.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
}

/// Exit code of a shell that does not find a command.
const NOT_FOUND: i32 = 127;

impl CustomError {
    /// Whether the command does not exist on this host.
    pub fn is_missing(&self) -> bool {
        matches!(self, Self::Failed { status, .. } if status.code() == Some(NOT_FOUND))
    }
}
