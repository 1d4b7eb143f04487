//! How the program ends: its exit codes.

use std::path::Path;
use std::process::ExitCode;

use crate::config::ConfigError;

/// How a command ended that did not fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExitStatus {
    /// All done.
    Done,
    /// A campaign is over, and none of its walks came to its end in order.
    NoWalkCompleted,
    /// Stopped by Ctrl-C or SIGTERM, in order.
    Interrupted,
}

/// Why a command failed.
#[derive(Debug)]
pub enum Failure {
    /// Wrong input or configuration: exit code 2.
    Input(String),
    /// Anything else: exit code 1.
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

impl Failure {
    /// Wrong input.
    pub fn input(error: impl ToString) -> Self {
        Self::Input(error.to_string())
    }

    /// Any other failure.
    pub fn failed(error: impl ToString) -> Self {
        Self::Failed(error.to_string())
    }

    /// What failed for no fault of the user says in which campaign it did.
    pub fn in_campaign(self, directory: &Path) -> Self {
        match self {
            Self::Failed(message) => Self::Failed(format!("campaign in {}: {message}", directory.display())),
            input => input,
        }
    }

    /// 2 or 1.
    pub fn exit_code(&self) -> ExitCode {
        ExitCode::from(match self {
            Self::Input(_) => 2,
            Self::Failed(_) => 1,
        })
    }
}

impl std::fmt::Display for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (Self::Input(message) | Self::Failed(message)) = self;
        f.write_str(message)
    }
}

impl From<ConfigError> for Failure {
    fn from(error: ConfigError) -> Self {
        Self::input(error)
    }
}

impl From<store::StoreError> for Failure {
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
