//! What killed programs left on this host: directories with the server's package, and arenas. Who made one holds a lock on it.

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

/// Prefix of the names of package directories.
pub(crate) const PACKAGE_PREFIX: &str = "calmwalk-server-";
/// Prefix and part of the names of arenas.
pub(crate) const ARENA: (&str, &str) = ("calmwalk-", "-arena-");

/// Where files are in memory.
pub(crate) fn memory() -> PathBuf {
    let shared = Path::new("/dev/shm");
    if shared.is_dir() { shared.to_owned() } else { std::env::temp_dir() }
}

/// Locks a new file or directory. Returns whether it is there and ours: another program may have removed it as abandoned.
pub(crate) fn hold(held: &File, path: &Path) -> bool {
    !matches!(held.try_lock(), Err(TryLockError::WouldBlock)) && path.exists()
}

/// Removes package directories and arenas that killed programs left on this host, as far as permissions allow.
pub fn remove_abandoned() {
    remove_abandoned_in(&std::env::temp_dir(), &memory());
}

fn remove_abandoned_in(temporary: &Path, memory: &Path) {
    let is_package = |name: &str| name.starts_with(PACKAGE_PREFIX);
    let is_arena = |name: &str| name.starts_with(ARENA.0) && name.contains(ARENA.1);
    for directory in named(temporary, is_package) {
        remove_if_free(&directory, fs::Metadata::is_dir, |path| fs::remove_dir_all(path));
    }
    for arena in named(memory, is_arena) {
        remove_if_free(&arena, fs::Metadata::is_file, |path| fs::remove_file(path));
    }
}

fn named(directory: &Path, is_wanted: impl Fn(&str) -> bool) -> Vec<PathBuf> {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    entries
        .filter(|entry| is_wanted(&entry.file_name().to_string_lossy()))
        .map(|entry| entry.path())
        .collect()
}

/// Another user may have created something of that name. A pipe would block.
fn remove_if_free(path: &Path, is_kind: fn(&fs::Metadata) -> bool, remove: fn(&Path) -> io::Result<()>) {
    if path.symlink_metadata().is_ok_and(|found| is_kind(&found))
        && let Ok(held) = File::open(path)
        && held.try_lock().is_ok()
    {
        let _ = remove(path);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arena::Arena;
    use crate::device::PackageDir;

    #[test]
    fn only_what_nobody_holds_is_removed() {
        let here = tempfile::tempdir().unwrap();
        let mut arena = Arena::new(here.path(), 0);
        arena.reserve(100).unwrap();
        let package = PackageDir::new_in(here.path()).unwrap();
        let file = |name: &str| here.path().join(name);
        fs::create_dir(file("calmwalk-server-abc")).unwrap();
        for name in ["calmwalk-server-file", "calmwalk-12-0-arena-1", "another-12-0-arena-1"] {
            fs::write(file(name), "").unwrap();
        }
        remove_abandoned_in(here.path(), here.path());
        assert!(arena.path().exists() && package.path().exists());
        assert!(file("calmwalk-server-file").exists() && file("another-12-0-arena-1").exists());
        assert!(!file("calmwalk-server-abc").exists() && !file("calmwalk-12-0-arena-1").exists());
    }
}
