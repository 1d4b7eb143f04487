//! A directory that gets its final name once it is complete.

use std::fs::{self, DirBuilder, File};
use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};

use rustix::fs::{CWD, RenameFlags, renameat_with};

use crate::error::{Result, StoreError};
use crate::filesystem::check_directory;

/// A directory under a temporary name beside its target. Removed on drop unless published.
pub(super) struct StagedDirectory {
    path: PathBuf,
}

impl StagedDirectory {
    /// Creates it. Removes what a killed process left under the temporary name.
    pub fn beside(target: &Path) -> Result<Self> {
        if target.symlink_metadata().is_ok() {
            return Err(StoreError::BackupExists { path: target.into() });
        }
        let failed = |source| StoreError::Directory { directory: target.into(), source };
        let name = target.file_name().ok_or_else(|| failed(io::ErrorKind::InvalidFilename.into()))?;
        let parent = parent(target);
        check_directory(parent)?;
        let path = parent.join(format!(".{}.unfinished-backup", name.to_string_lossy()));
        match fs::remove_dir_all(&path) {
            Err(source) if source.kind() != io::ErrorKind::NotFound => return Err(failed(source)),
            _ => {}
        }
        DirBuilder::new().mode(0o700).create(&path).map_err(failed)?;
        Ok(Self { path })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Renames it to its final name, unless that exists meanwhile.
    pub fn publish(self, target: &Path) -> Result<()> {
        let failed = |source: io::Error| StoreError::File { path: target.into(), source };
        for entry in fs::read_dir(&self.path).map_err(failed)? {
            File::open(entry.map_err(failed)?.path()).and_then(|file| file.sync_all()).map_err(failed)?;
        }
        File::open(&self.path).and_then(|directory| directory.sync_all()).map_err(failed)?;
        let renamed = renameat_with(CWD, &self.path, CWD, target, RenameFlags::NOREPLACE);
        renamed.map_err(|error| match error {
            rustix::io::Errno::EXIST => StoreError::BackupExists { path: target.into() },
            error => failed(error.into()),
        })?;
        File::open(parent(target)).and_then(|directory| directory.sync_all()).map_err(failed)
    }
}

impl Drop for StagedDirectory {
    fn drop(&mut self) {
        // Once published, it no longer has this name.
        let _ = fs::remove_dir_all(&self.path);
    }
}

fn parent(path: &Path) -> &Path {
    path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}
