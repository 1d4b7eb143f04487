//! Listing and removing files.

use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use super::error::{ShmDirError, io_error};

/// What was removed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Removed {
    /// Number of files, without directories.
    pub files: usize,
    /// Memory they used, bytes.
    pub bytes: u64,
}

/// Entries of a directory; empty if it does not exist.
pub(super) fn entries(directory: &Path) -> Result<Vec<PathBuf>, ShmDirError> {
    let listed = match fs::read_dir(directory) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        listed => listed.map_err(io_error("list", directory))?,
    };
    listed.map(|entry| entry.map(|entry| entry.path()).map_err(io_error("list", directory))).collect()
}

pub(super) fn remove_tree(path: &Path, removed: &mut Removed) -> Result<(), ShmDirError> {
    match path.symlink_metadata() {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(io_error("inspect", path)(error)),
        Ok(found) if found.is_dir() => {
            entries(path)?.iter().try_for_each(|entry| remove_tree(entry, removed))?;
            ignore_not_found(fs::remove_dir(path)).map_err(io_error("remove", path))
        }
        Ok(_) => remove_file(path, removed),
    }
}

/// Adds what [`remove_tree`] would remove.
pub(super) fn count_tree(path: &Path, found: &mut Removed) -> Result<(), ShmDirError> {
    match path.symlink_metadata() {
        Ok(this) if this.is_dir() => entries(path)?.iter().try_for_each(|entry| count_tree(entry, found)),
        Ok(_) => {
            count_file(path, found);
            Ok(())
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(io_error("inspect", path)(error)),
    }
}

pub(super) fn count_file(path: &Path, found: &mut Removed) {
    found.files += 1;
    found.bytes += 512 * path.symlink_metadata().map_or(0, |file| file.blocks());
}

pub(super) fn remove_file(path: &Path, removed: &mut Removed) -> Result<(), ShmDirError> {
    let blocks = path.symlink_metadata().map_or(0, |file| file.blocks());
    ignore_not_found(fs::remove_file(path)).map_err(io_error("remove", path))?;
    removed.files += 1;
    removed.bytes += 512 * blocks;
    Ok(())
}

fn ignore_not_found(result: io::Result<()>) -> io::Result<()> {
    if result.as_ref().is_err_and(|error| error.kind() == io::ErrorKind::NotFound) { Ok(()) } else { result }
}
