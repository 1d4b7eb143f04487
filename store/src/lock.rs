//! One process runs a campaign: an advisory lock on a file beside the database, or of the server. It is released when the
//! process ends, however it ends.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Seek, Write};
use std::path::Path;

use crate::error::{Result, StoreError};
use crate::location::Location;
use crate::postgres::leadership::Leadership;

/// Name of the file that is locked, in the campaign's directory.
pub const LOCK: &str = "campaign.lock";

/// The right to run a campaign, until it is dropped.
#[derive(Debug)]
pub struct CampaignLock(Held);

#[derive(Debug)]
enum Held {
    /// Closed, it is free.
    File {
        _file: File,
    },
    Session(Leadership),
}

impl CampaignLock {
    /// Takes the lock of the campaign in a directory (see [`Self::acquire`]) or on a server, where its tables are made
    /// if they are not there yet.
    pub async fn acquire_at(location: impl Into<Location>, who: &str) -> Result<Self> {
        match location.into() {
            Location::Directory(directory) => Self::acquire(&directory, who),
            Location::Server(url) => Ok(Self(Held::Session(Leadership::take(&url, who).await?))),
        }
    }

    /// Waits until the lock is not held any longer, and says who has it. On a server a connection may break; it is taken
    /// again then, if nobody else had it meanwhile. A file stays locked for as long as its process lives.
    pub async fn lost(&self) -> StoreError {
        match &self.0 {
            Held::File { .. } => std::future::pending().await,
            Held::Session(leadership) => leadership.lost().await,
        }
    }

    /// What tells the transactions of this holder from those of earlier ones.
    pub(crate) fn generation(&self) -> Option<i64> {
        match &self.0 {
            Held::File { .. } => None,
            Held::Session(leadership) => Some(leadership.generation),
        }
    }

    /// Takes the lock of the campaign in `directory`, or says who has it. `who` is written into the file beside
    /// the process number, for the message that a second process gets.
    pub fn acquire(directory: &Path, who: &str) -> Result<Self> {
        let path = directory.join(LOCK);
        let failed = |source: io::Error| match source.kind() {
            io::ErrorKind::NotFound | io::ErrorKind::PermissionDenied | io::ErrorKind::NotADirectory => {
                StoreError::Directory { directory: directory.into(), source }
            }
            io::ErrorKind::StorageFull => StoreError::DiskFull,
            _ => StoreError::File { path: path.clone(), source },
        };
        let open = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path);
        let mut file = open.map_err(failed)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let holder = fs::read_to_string(&path).unwrap_or_default();
                let holder = if holder.trim().is_empty() { "another process" } else { holder.trim() };
                let location = directory.display().to_string();
                return Err(StoreError::Locked { location, holder: holder.into() });
            }
            Err(TryLockError::Error(source)) => return Err(failed(source)),
        }
        let line = format!("process {} ({who}) on {}\n", std::process::id(), crate::processes::this_host());
        file.set_len(0).map_err(failed)?;
        file.rewind().map_err(failed)?;
        file.write_all(line.as_bytes()).map_err(failed)?;
        Ok(Self(Held::File { _file: file }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_holder_is_told_the_process_and_the_lock_comes_free() {
        let directory = tempfile::tempdir().unwrap();
        let lock = CampaignLock::acquire(directory.path(), "run").unwrap();
        let message = CampaignLock::acquire(directory.path(), "run").unwrap_err().to_string();
        assert!(message.contains(&format!("process {} (run)", std::process::id())), "{message}");
        drop(lock);
        CampaignLock::acquire(directory.path(), "again").unwrap();
    }

    #[test]
    fn a_missing_directory_is_named() {
        let directory = tempfile::tempdir().unwrap();
        let missing = directory.path().join("missing");
        let error = CampaignLock::acquire(&missing, "run").unwrap_err();
        assert!(matches!(error, StoreError::Directory { .. }), "{error}");
    }
}
