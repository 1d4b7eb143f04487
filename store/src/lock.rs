//! Only one process runs a campaign: it holds an advisory lock on the campaign's directory and on a file in it, or
//! on the server. The lock is released when the process ends, in whatever way.
//!
//! The file names the holder, and earlier versions lock only the file. It can be deleted; the directory cannot be
//! deleted without the database.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Seek, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use crate::error::{Result, StoreError};
use crate::file_names::LOCK;
use crate::location::Location;
use crate::postgres::leadership::Leadership;

/// The right to run a campaign. Released on drop.
#[derive(Debug)]
pub struct CampaignLock(HeldLock);

#[derive(Debug)]
enum HeldLock {
    Directory { _lock: DirectoryLock },
    Session(Leadership),
}

/// A locked directory and the lock file in it.
#[derive(Debug)]
struct DirectoryLock {
    file: File,
    /// `None` on file systems that cannot lock directories (NFS); there the file decides.
    directory: Option<File>,
}

impl Drop for DirectoryLock {
    /// Closing the files is not enough: a child that is being spawned inherits them until it executes its program.
    fn drop(&mut self) {
        for file in self.directory.iter().chain([&self.file]) {
            // If unlocking fails, the lock is released with the last open file handle.
            let _ = file.unlock();
        }
    }
}

impl CampaignLock {
    /// Acquires the lock of a campaign in a directory (see [`Self::acquire`]) or on a server. Creates the tables on
    /// the server if they do not exist.
    pub async fn acquire_at(location: impl Into<Location>, who: &str) -> Result<Self> {
        match location.into() {
            Location::Directory(directory) => Self::acquire(&directory, who),
            Location::Server(url) => Ok(Self(HeldLock::Session(Leadership::take(&url, who).await?))),
        }
    }

    /// Waits until the lock is lost, and names the new holder. A broken connection to a server is restored if no
    /// other process took the lock meanwhile. A lock on a directory lasts as long as its process.
    pub async fn lost(&self) -> StoreError {
        match &self.0 {
            HeldLock::Directory { .. } => std::future::pending().await,
            HeldLock::Session(leadership) => leadership.lost().await,
        }
    }

    /// The fencing token: it distinguishes transactions of this holder from those of earlier ones.
    pub(crate) fn generation(&self) -> Option<i64> {
        match &self.0 {
            HeldLock::Directory { .. } => None,
            HeldLock::Session(leadership) => Some(leadership.generation),
        }
    }

    /// Acquires the lock of the campaign in `directory`. Writes `who` and the process id into the lock file, for
    /// the error message that a second process gets.
    pub fn acquire(directory: &Path, who: &str) -> Result<Self> {
        let path = directory.join(LOCK);
        let failed = |source: io::Error| match source.kind() {
            io::ErrorKind::NotFound | io::ErrorKind::PermissionDenied | io::ErrorKind::NotADirectory => {
                StoreError::Directory { directory: directory.into(), source }
            }
            io::ErrorKind::StorageFull => StoreError::DiskFull,
            _ => StoreError::File { path: path.clone(), source },
        };
        let locked = || {
            let holder = fs::read_to_string(&path).unwrap_or_default();
            let holder = if holder.trim().is_empty() { "another process" } else { holder.trim() };
            StoreError::Locked { location: directory.display().to_string(), holder: holder.into() }
        };
        let opened = File::open(directory).map_err(failed)?;
        let opened = match opened.try_lock() {
            Ok(()) => Some(opened),
            Err(TryLockError::WouldBlock) => return Err(locked()),
            Err(TryLockError::Error(_)) => None,
        };
        let open =
            OpenOptions::new().read(true).write(true).create(true).truncate(false).mode(0o600).open(&path);
        let mut held = DirectoryLock { file: open.map_err(failed)?, directory: opened };
        match held.file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(locked()),
            Err(TryLockError::Error(source)) => return Err(failed(source)),
        }
        let line = format!("process {} ({who}) on {}\n", std::process::id(), crate::processes::this_host());
        held.file.set_len(0).map_err(failed)?;
        held.file.rewind().map_err(failed)?;
        held.file.write_all(line.as_bytes()).map_err(failed)?;
        Ok(Self(HeldLock::Directory { _lock: held }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_holder_learns_of_the_process_and_the_lock_is_released() {
        let directory = tempfile::tempdir().unwrap();
        let lock = CampaignLock::acquire(directory.path(), "run").unwrap();
        let message = CampaignLock::acquire(directory.path(), "run").unwrap_err().to_string();
        assert!(message.contains(&format!("process {} (run)", std::process::id())), "{message}");
        drop(lock);
        CampaignLock::acquire(directory.path(), "again").unwrap();
    }

    #[test]
    fn deleting_the_file_does_not_release_the_lock() {
        let directory = tempfile::tempdir().unwrap();
        let lock = CampaignLock::acquire(directory.path(), "run").unwrap();
        fs::remove_file(directory.path().join(LOCK)).unwrap();
        let error = CampaignLock::acquire(directory.path(), "run").unwrap_err();
        assert!(matches!(error, StoreError::Locked { .. }), "{error}");
        assert!(!directory.path().join(LOCK).exists(), "the holder's name is not overwritten");
        drop(lock);
        CampaignLock::acquire(directory.path(), "again").unwrap();
    }

    /// An earlier version, which locks only the file.
    #[test]
    fn a_holder_of_the_file_alone_is_respected() {
        let directory = tempfile::tempdir().unwrap();
        let file = File::create(directory.path().join(LOCK)).unwrap();
        file.lock().unwrap();
        let error = CampaignLock::acquire(directory.path(), "run").unwrap_err();
        assert!(matches!(error, StoreError::Locked { .. }), "{error}");
        drop(file);
        CampaignLock::acquire(directory.path(), "run").unwrap();
    }

    #[test]
    fn a_missing_directory_is_named() {
        let directory = tempfile::tempdir().unwrap();
        let missing = directory.path().join("missing");
        let error = CampaignLock::acquire(&missing, "run").unwrap_err();
        assert!(matches!(error, StoreError::Directory { .. }), "{error}");
    }
}
