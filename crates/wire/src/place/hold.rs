//! Who holds a place: a process that uses it has it locked until its end, however it ends.
//!
//! The system's locks on the directories themselves are used, which need no file, also hold between containers that
//! share `/dev/shm`, and come free when a process dies.

use std::fs::{self, File, TryLockError};
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use super::error::{PlaceError, io_error};
use super::home;
use super::private::{make_private, user};

/// The right to make and remove places of this user, for a moment. While somebody has it, no place comes, goes or
/// changes its holder.
pub(super) struct Turn(File);

impl Turn {
    /// Waits for it.
    pub(super) fn wait() -> Result<Self, PlaceError> {
        let home = home();
        loop {
            make_private(&home, user())?;
            let file = match File::open(&home) {
                Err(error) if error.kind() == std::io::ErrorKind::NotFound => continue,
                file => file.map_err(io_error("open", &home))?,
            };
            file.lock().map_err(io_error("lock", &home))?;
            // Whoever had it before may have removed the directory, and a new one has another lock.
            if file.metadata().map_err(io_error("look at", &home))?.nlink() > 0 {
                return Ok(Self(file));
            }
        }
    }
}

impl Drop for Turn {
    /// Leaves no empty directory behind.
    fn drop(&mut self) {
        // Fails where there are places.
        let _ = fs::remove_dir(home());
        unlock(&self.0);
    }
}

/// The directory of a place, locked.
#[derive(Debug)]
pub(super) struct Hold(File);

impl Drop for Hold {
    fn drop(&mut self) {
        unlock(&self.0);
    }
}

/// Shutdown the file is not enough at once: a process that is just being started has it too, until its program begins.
fn unlock(file: &File) {
    // What cannot be unlocked comes free with the last who has the file.
    let _ = file.unlock();
}

impl Hold {
    /// Takes it, unless somebody else has it. To be called by whoever has the [`Turn`].
    pub(super) fn take(directory: &Path, campaign: Option<&Path>) -> Result<Self, PlaceError> {
        let file = File::open(directory).map_err(io_error("open", directory))?;
        match file.try_lock() {
            Ok(()) => Ok(Self(file)),
            Err(TryLockError::Error(source)) => Err(io_error("lock", directory)(source)),
            Err(TryLockError::WouldBlock) => Err(PlaceError::InUse {
                path: directory.to_owned(),
                campaign: campaign.map_or_else(String::new, |path| format!(" in {}", path.display())),
            }),
        }
    }
}
