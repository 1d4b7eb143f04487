//! Why a place cannot be used.

use std::io;
use std::path::{Path, PathBuf};

/// Why a place cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ShmDirError {
    /// The operating system says no.
    #[error("cannot {what} {}: {source}", path.display())]
    Io {
        /// What was tried.
        what: &'static str,
        /// With which file.
        path: PathBuf,
        /// What came of it.
        source: io::Error,
    },
    /// Somebody else made it, or others may write to it.
    #[error(
        "{} {found}, expected a directory of user {uid} with mode 0700: whoever made it must remove it, \
         or use `--in-process`",
        path.display()
    )]
    NotPrivate {
        /// The directory.
        path: PathBuf,
        /// What it is instead.
        found: String,
        /// This user.
        uid: u32,
    },
    /// A run that is alive.
    #[error(
        "a process that runs the campaign{campaign} holds {}: wait for it or stop it first (it may be in a container \
         that shares /dev/shm)",
        path.display()
    )]
    InUse {
        /// The directory of the place.
        path: PathBuf,
        /// Where the campaign is, as far as that is known.
        campaign: String,
    },
    /// Shared memory is too small. Going on would end with SIGBUS in the middle of a write.
    #[error(
        "the campaign needs {} of shared memory and /dev/shm has {} free: enlarge /dev/shm (in a container \
         `--shm-size`), use fewer walkers, or use `--in-process`; `calmwalk clean` removes what dead campaigns left",
        megabytes(*needed),
        megabytes(*free)
    )]
    Space {
        /// Bytes.
        needed: u64,
        /// Bytes.
        free: u64,
    },
}

fn megabytes(bytes: u64) -> String {
    format!("{:.1} MB", bytes as f64 / 1e6)
}

pub(super) fn io_error(what: &'static str, path: &Path) -> impl FnOnce(io::Error) -> ShmDirError {
    move |source| ShmDirError::Io { what, path: path.to_owned(), source }
}
