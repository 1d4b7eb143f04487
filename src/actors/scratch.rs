//! The directory in which an agent keeps what it needs in the meantime. It is locked: one that nobody holds is of an agent that
//! was killed.

use std::fs::{self, File, TryLockError};
use std::io::{ErrorKind, Result};
use std::path::Path;

use tempfile::{Builder, TempDir};
use wire::shm_dir::ShmDir;

/// Their names begin with this.
const PREFIX: &str = "calmwalk-agent-";

/// Removed when it is dropped.
pub struct Scratch {
    directory: TempDir,
    /// Closed, it is free.
    _held: File,
}

impl Scratch {
    /// A new one among the system's temporary files.
    pub fn new() -> Result<Self> {
        loop {
            let directory = Builder::new().prefix(PREFIX).tempdir()?;
            let _held = match File::open(directory.path()) {
                // Somebody who cleans up was faster.
                Err(error) if error.kind() == ErrorKind::NotFound => continue,
                opened => opened?,
            };
            let is_ours = !matches!(_held.try_lock(), Err(TryLockError::WouldBlock));
            if is_ours && directory.path().exists() {
                return Ok(Self { directory, _held });
            }
        }
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        self.directory.path()
    }
}

/// Removes what agents left that were killed on this host, as far as it may be removed.
pub fn clean() {
    for place in ShmDir::all().unwrap_or_default() {
        let Some(directory) = place.campaign_directory() else { continue };
        // Those of the living are in use and stay.
        if is_scratch(directory) && place.remove().is_ok() {
            remove_if_free(directory);
        }
    }
    for entry in fs::read_dir(std::env::temp_dir()).into_iter().flatten().flatten() {
        if is_scratch(&entry.path()) {
            remove_if_free(&entry.path());
        }
    }
}

/// What has such a name may be somebody else's: a pipe would hold this up.
fn remove_if_free(directory: &Path) {
    if !directory.symlink_metadata().is_ok_and(|found| found.is_dir()) {
        return;
    }
    if File::open(directory).is_ok_and(|held| held.try_lock().is_ok()) {
        let _ = fs::remove_dir_all(directory);
    }
}

fn is_scratch(directory: &Path) -> bool {
    directory.file_name().is_some_and(|name| name.to_string_lossy().starts_with(PREFIX))
}
