//! Detects whether the database file was replaced after it was opened.

use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use crate::error::{Result, StoreError};

/// The identity of the opened file. Anything written to a deleted or replaced file would be lost silently.
#[derive(Clone, Debug)]
pub(super) struct FileIdentity {
    path: PathBuf,
    /// Device and inode number.
    identity: (u64, u64),
}

impl FileIdentity {
    pub fn read(path: &Path) -> Result<Self> {
        let identity = identity(path).map_err(|source| StoreError::File { path: path.into(), source })?;
        Ok(Self { path: path.into(), identity })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn check(&self) -> Result<()> {
        match identity(&self.path) {
            Ok(found) if found == self.identity => Ok(()),
            Err(source) if source.kind() != io::ErrorKind::NotFound => {
                Err(StoreError::File { path: self.path.clone(), source })
            }
            _ => Err(StoreError::Removed { path: self.path.clone() }),
        }
    }
}

fn identity(path: &Path) -> io::Result<(u64, u64)> {
    fs::metadata(path).map(|file| (file.dev(), file.ino()))
}
