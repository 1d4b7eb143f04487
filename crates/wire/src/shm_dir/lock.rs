//! Locks on a campaign's directory: a process that uses it keeps it locked until it exits.
//!
//! Uses `flock` on the directories themselves. This needs no extra file, works between containers that share
//! `/dev/shm`, and the kernel releases the lock when the process dies.

use std::fs::{self, File, TryLockError};
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use super::error::{ShmDirError, io_error};
use super::private::{create_private, user, user_root};

/// A short-term lock on all directories of this user. While it is held, no directory is created, removed or locked by
/// another process.
pub(super) struct UserLock(File);

impl UserLock {
    /// Waits for the lock.
    pub(super) fn wait() -> Result<Self, ShmDirError> {
        let root = user_root();
        loop {
            create_private(&root, user())?;
            let file = match File::open(&root) {
                Err(error) if error.kind() == std::io::ErrorKind::NotFound => continue,
                file => file.map_err(io_error("open", &root))?,
            };
            file.lock().map_err(io_error("lock", &root))?;
            // The previous holder may have removed the directory; a new one has another lock.
            if file.metadata().map_err(io_error("inspect", &root))?.nlink() > 0 {
                return Ok(Self(file));
            }
        }
    }
}

impl Drop for UserLock {
    /// Removes the directory if it is empty.
    fn drop(&mut self) {
        // Fails if the directory is not empty.
        let _ = fs::remove_dir(user_root());
        unlock(&self.0);
    }
}

/// The lock on the directory of one campaign.
#[derive(Debug)]
pub(super) struct DirLock(File);

impl Drop for DirLock {
    fn drop(&mut self) {
        unlock(&self.0);
    }
}

/// Shutdown the file would not release the lock immediately: a process that is being started shares it until `exec`.
fn unlock(file: &File) {
    // If this fails, the lock is released when the last process closes the file.
    let _ = file.unlock();
}

impl DirLock {
    /// Takes the lock, or fails if another process has it. The caller must hold the [`UserLock`].
    pub(super) fn take(directory: &Path, campaign: Option<&Path>) -> Result<Self, ShmDirError> {
        let file = File::open(directory).map_err(io_error("open", directory))?;
        match file.try_lock() {
            Ok(()) => Ok(Self(file)),
            Err(TryLockError::Error(source)) => Err(io_error("lock", directory)(source)),
            Err(TryLockError::WouldBlock) => Err(ShmDirError::InUse {
                path: directory.to_owned(),
                campaign: campaign.map_or_else(String::new, |path| format!(" in {}", path.display())),
            }),
        }
    }
}
