//! Why the jobs of a campaign cannot be handled.

use std::io;
use std::path::{Path, PathBuf};

use ::batch::{CustomError, SlurmError};

/// Why the jobs of a campaign cannot be handled.
#[derive(Debug, thiserror::Error)]
pub enum BatchError {
    /// A command of Slurm failed.
    #[error(transparent)]
    Slurm(#[from] SlurmError),
    /// A command of a custom batch system failed.
    #[error(transparent)]
    Custom(#[from] CustomError),
    /// The file with the jobs cannot be read or written.
    #[error("{}: {source}", path.display())]
    Records {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: io::Error,
    },
}

impl BatchError {
    /// Whether the batch system is not installed on this host.
    pub fn is_missing(&self) -> bool {
        match self {
            Self::Slurm(error) => error.is_missing(),
            Self::Custom(error) => error.is_missing(),
            Self::Records { .. } => false,
        }
    }

    pub(super) fn records(path: &Path) -> impl FnOnce(io::Error) -> Self + use<> {
        let path = path.to_owned();
        move |source| Self::Records { path, source }
    }
}
