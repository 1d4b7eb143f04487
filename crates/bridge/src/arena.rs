//! A file in shared memory, through which numbers go to the server and back.

use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use memmap2::MmapMut;
use rustix::fs::{FallocateFlags, fallocate};

use crate::abandoned::{ARENA, hold};

/// The smallest arena, bytes.
const SMALLEST: usize = 1 << 20;

/// A file that grows, for this user only. The server maps it again when its path has changed.
#[derive(Debug)]
pub(crate) struct Arena {
    directory: PathBuf,
    number: usize,
    path: PathBuf,
    /// Whether the file still has its name.
    is_named: bool,
    map: Option<MmapMut>,
    /// Locked while this program runs, so that other programs do not remove it as abandoned.
    held: Option<File>,
}

impl Arena {
    /// An arena without memory, in a directory of shared memory.
    pub fn new(directory: &Path, number: usize) -> Self {
        Self {
            directory: directory.to_owned(),
            number,
            path: PathBuf::new(),
            is_named: false,
            map: None,
            held: None,
        }
    }

    /// Makes room for so many bytes. Returns whether the contents are lost.
    ///
    /// # Errors
    /// Errors of the operating system, such as shared memory that is full.
    pub fn reserve(&mut self, bytes: usize) -> io::Result<bool> {
        if self.map.as_ref().is_some_and(|map| map.len() >= bytes) {
            return Ok(false);
        }
        self.remove();
        let size = bytes.next_power_of_two().max(SMALLEST);
        let file = loop {
            self.path = self.directory.join(unique_name(self.number));
            let file =
                OpenOptions::new().read(true).write(true).create_new(true).mode(0o600).open(&self.path)?;
            if hold(&file, &self.path) {
                break file;
            }
        };
        self.is_named = true;
        // Without memory behind it, a write would kill the process.
        let map = fallocate(&file, FallocateFlags::empty(), 0, size as u64)
            .map_err(io::Error::from)
            .and_then(|()| map(&file));
        self.map = Some(map.inspect_err(|_| self.unlink())?);
        self.held = Some(file);
        Ok(true)
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Size of the file, bytes.
    pub fn len(&self) -> usize {
        self.map.as_ref().map_or(0, |map| map.len())
    }

    /// The memory.
    pub fn bytes(&mut self) -> &mut [u8] {
        self.map.as_deref_mut().unwrap_or_default()
    }

    /// Removes the name of the file. Who has mapped it keeps it.
    pub fn unlink(&mut self) {
        if std::mem::take(&mut self.is_named) {
            let _ = std::fs::remove_file(&self.path);
        }
    }

    fn remove(&mut self) {
        self.map = None;
        self.unlink();
        self.held = None;
    }
}

impl Drop for Arena {
    fn drop(&mut self) {
        self.remove();
    }
}

/// No other arena of this host has this name.
fn unique_name(number: usize) -> String {
    use std::sync::atomic::{AtomicU32, Ordering};
    static NEXT: AtomicU32 = AtomicU32::new(0);
    let (prefix, arena) = ARENA;
    format!("{prefix}{}-{}{arena}{number}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed))
}

#[allow(unsafe_code)]
fn map(file: &File) -> io::Result<MmapMut> {
    // SAFETY: the file is new and has its full size. Only the server that this program started maps it too, and it writes only while
    // this program waits for its answer; whatever it writes, all of it are numbers of which any bits are valid.
    unsafe { MmapMut::map_mut(file) }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn an_arena_is_for_this_user_only() {
        let directory = tempfile::tempdir().unwrap();
        let mut arena = Arena::new(directory.path(), 0);
        arena.reserve(100).unwrap();
        let mode = std::fs::metadata(arena.path()).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
    }
}
