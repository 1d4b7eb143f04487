//! Errors of the shared memory directory.

use std::io;
use std::path::{Path, PathBuf};

/// Why the shared memory directory cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ShmDirError {
    /// An error of the operating system.
    #[error("cannot {what} {}: {source}", path.display())]
    Io {
        /// The operation.
        what: &'static str,
        /// The file.
        path: PathBuf,
        /// The error.
        source: io::Error,
    },
    /// Another user owns it, or others have write access.
    #[error(
        "{} {found}, expected a directory of user {uid} with mode 0700: its owner must remove it, \
         or use `--in-process`",
        path.display()
    )]
    NotPrivate {
        /// The directory.
        path: PathBuf,
        /// What was found instead.
        found: String,
        /// This user.
        uid: u32,
    },
    /// A run is active.
    #[error(
        "another process runs the campaign{campaign} and has locked {}: wait for it or stop it first (it may be in a container \
         that shares /dev/shm)",
        path.display()
    )]
    InUse {
        /// The locked directory.
        path: PathBuf,
        /// Location of the campaign, if known.
        campaign: String,
    },
    /// Not enough shared memory. Continuing would end with SIGBUS during a write.
    #[error(
        "the campaign needs {} of shared memory and /dev/shm has {} free: enlarge /dev/shm (in a container \
         `--shm-size`), use fewer walkers, or use `--in-process`; `calmwalk clean` removes what dead campaigns left",
        megabytes(*needed),
        megabytes(*free)
    )]
    Space {
        /// Required, bytes.
        needed: u64,
        /// Free, bytes.
        free: u64,
    },
}

fn megabytes(bytes: u64) -> String {
    format!("{:.1} MB", bytes as f64 / 1e6)
}

pub(super) fn io_error(what: &'static str, path: &Path) -> impl FnOnce(io::Error) -> ShmDirError {
    move |source| ShmDirError::Io { what, path: path.to_owned(), source }
}
