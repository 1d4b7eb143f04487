//! Exit codes of the program.

use std::path::Path;
use std::process::ExitCode;

use atoms::FileError;

use crate::config::ConfigError;

/// How a command ended without a failure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExitStatus {
    /// Finished.
    Done,
    /// A campaign is over, but every walk ended early.
    NoWalkCompleted,
    /// Stopped in order by Ctrl-C or SIGTERM.
    Interrupted,
}

/// Why a command failed.
#[derive(Debug)]
pub enum CommandError {
    /// Wrong input or configuration: exit code 2.
    Input(String),
    /// A file that the system cannot open or read: exit code 2. Where the file was read before, it is no wrong input.
    Unreadable(String),
    /// Any other failure: exit code 1.
    Failed(String),
}

impl ExitStatus {
    /// 0, 1 or 130.
    pub fn exit_code(self) -> ExitCode {
        ExitCode::from(match self {
            Self::Done => 0,
            Self::NoWalkCompleted => 1,
            Self::Interrupted => 130,
        })
    }
}

impl CommandError {
    /// Wrong input.
    pub fn input(error: impl ToString) -> Self {
        Self::Input(error.to_string())
    }

    /// Any other failure.
    pub fn failed(error: impl ToString) -> Self {
        Self::Failed(error.to_string())
    }

    /// Names the campaign in the message, unless the input was wrong.
    pub fn in_campaign(self, directory: &Path) -> Self {
        match self {
            Self::Failed(message) => Self::Failed(format!("campaign in {}: {message}", directory.display())),
            input => input,
        }
    }

    /// 2 or 1.
    pub fn exit_code(&self) -> ExitCode {
        ExitCode::from(match self {
            Self::Input(_) | Self::Unreadable(_) => 2,
            Self::Failed(_) => 1,
        })
    }
}

impl std::fmt::Display for CommandError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (Self::Input(message) | Self::Unreadable(message) | Self::Failed(message)) = self;
        f.write_str(message)
    }
}

impl From<FileError> for CommandError {
    fn from(error: FileError) -> Self {
        match error.is_of_system() {
            true => Self::Unreadable(error.to_string()),
            false => Self::input(error),
        }
    }
}

impl From<ConfigError> for CommandError {
    fn from(error: ConfigError) -> Self {
        Self::input(error)
    }
}

impl From<store::StoreError> for CommandError {
    fn from(error: store::StoreError) -> Self {
        use store::StoreError as E;
        match error {
            E::Database(_)
            | E::DiskFull
            | E::Busy
            | E::Damaged { .. }
            | E::Inconsistent(_)
            | E::LockLost { .. }
            | E::Unreachable(_)
            | E::Removed { .. } => Self::failed(error),
            _ => Self::input(error),
        }
    }
}
