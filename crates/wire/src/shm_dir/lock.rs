//! Who holds a place: a process that uses it has it locked until its end, however it ends.
//!
//! The system's locks on the directories themselves are used, which need no file, also hold between containers that
//! share `/dev/shm`, and come free when a process dies.

use std::fs::{self, File, TryLockError};
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use super::error::{ShmDirError, io_error};
use super::private::{make_private, user};
use super::user_root;

/// The right to make and remove places of this user, for a moment. While somebody has it, no place comes, goes or
/// changes its holder.
pub(super) struct UserLock(File);

impl UserLock {
    /// Waits for it.
    pub(super) fn wait() -> Result<Self, ShmDirError> {
        let root = user_root();
        loop {
            make_private(&root, user())?;
            let file = match File::open(&root) {
                Err(error) if error.kind() == std::io::ErrorKind::NotFound => continue,
                file => file.map_err(io_error("open", &root))?,
            };
            file.lock().map_err(io_error("lock", &root))?;
            // Whoever had it before may have removed the directory, and a new one has another lock.
            if file.metadata().map_err(io_error("look at", &root))?.nlink() > 0 {
                return Ok(Self(file));
            }
        }
    }
}

impl Drop for UserLock {
    /// Leaves no empty directory behind.
    fn drop(&mut self) {
        // Fails where there are places.
        let _ = fs::remove_dir(user_root());
        unlock(&self.0);
    }
}

/// The directory of a place, locked.
#[derive(Debug)]
pub(super) struct DirLock(File);

impl Drop for DirLock {
    fn drop(&mut self) {
        unlock(&self.0);
    }
}

/// Closing the file is not enough at once: a process that is just being started has it too, until its program begins.
fn unlock(file: &File) {
    // What cannot be unlocked comes free with the last who has the file.
    let _ = file.unlock();
}

impl DirLock {
    /// Takes it, unless somebody else has it. To be called by whoever has the [`UserLock`].
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
