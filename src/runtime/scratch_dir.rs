//! The directory for an agent's temporary files. The agent locks it, so an unlocked one was left by a killed agent.

use std::fs::{self, File, TryLockError};
use std::io::{ErrorKind, Result};
use std::path::Path;

use tempfile::{Builder, TempDir};
use wire::shm_dir::ShmDir;

/// Prefix of the directories' names.
const PREFIX: &str = "calmwalk-agent-";

/// A directory that is removed on drop.
pub struct ScratchDir {
    directory: TempDir,
    /// Closing it releases the lock.
    _held: File,
}

impl ScratchDir {
    /// Creates one in the system's temporary directory.
    pub fn new() -> Result<Self> {
        loop {
            let directory = Builder::new().prefix(PREFIX).tempdir()?;
            let _held = match File::open(directory.path()) {
                // Another process removed it as abandoned.
                Err(error) if error.kind() == ErrorKind::NotFound => continue,
                opened => opened?,
            };
            let is_ours = !matches!(_held.try_lock(), Err(TryLockError::WouldBlock));
            if is_ours && directory.path().exists() {
                return Ok(Self { directory, _held });
            }
        }
    }

    /// Path of the directory.
    pub fn path(&self) -> &Path {
        self.directory.path()
    }
}

/// Removes what killed agents left on this host, as far as permissions allow.
pub fn clean() {
    for place in ShmDir::all().unwrap_or_default() {
        let Some(directory) = place.campaign_directory() else { continue };
        // Those of running agents are locked and stay.
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

/// Another user may have created something of that name. A pipe would block.
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
