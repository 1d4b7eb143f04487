//! Removes whatever a program left: directories of any depth, without permissions, with any content.

use std::ffi::{CStr, CString};
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::path::Path;

use rustix::fs::{AtFlags, CWD, Dir, Mode, OFlags, chmodat, openat, renameat, unlinkat};
use rustix::io::Errno;

/// Prefix of the names of moved directories.
const MOVED: &str = "calmwalk-moved-";

/// Removes a directory with its content. Links are removed, not followed. A missing directory is no error.
///
/// # Errors
/// The first entry that cannot be removed; everything else is removed.
pub(super) fn remove_tree(path: &Path) -> io::Result<()> {
    let root = match open(CWD, path) {
        Err(Errno::NOENT) => return Ok(()),
        root => root?,
    };
    let mut removal = Removal { root, moved: 0, first_error: None };
    loop {
        let before = removal.moved;
        for name in names(&removal.root)? {
            let removed = removal.remove(&name);
            removal.record_error(removed);
        }
        if removal.moved == before {
            break;
        }
    }
    match removal.first_error {
        Some(error) => Err(error.into()),
        None => missing_is_fine(unlinkat(CWD, path, AtFlags::REMOVEDIR)).map_err(io::Error::from),
    }
}

/// Moves nested directories to the root before it reads them, so that two descriptors suffice and no path gets
/// long.
struct Removal {
    root: OwnedFd,
    /// Number of moved directories.
    moved: u64,
    first_error: Option<Errno>,
}

impl Removal {
    /// Removes an entry of the root, after moving its directories up.
    fn remove(&mut self, name: &CStr) -> Result<(), Errno> {
        if remove_simple(&self.root, name)? {
            return Ok(());
        }
        let directory = open(&self.root, name)?;
        for child in names(&directory)? {
            let removed = match remove_simple(&directory, &child) {
                Ok(false) => self.move_up(&directory, &child),
                removed => removed.map(drop),
            };
            self.record_error(removed);
        }
        missing_is_fine(unlinkat(&self.root, name, AtFlags::REMOVEDIR))
    }

    fn move_up(&mut self, from: &OwnedFd, name: &CStr) -> Result<(), Errno> {
        // Moving a directory changes its entry `..`, which counts as writing to it.
        chmodat(from, name, Mode::RWXU, AtFlags::empty())?;
        loop {
            self.moved += 1;
            let free = CString::new(format!("{MOVED}{}", self.moved)).map_err(|_| Errno::INVAL)?;
            match renameat(from, name, &self.root, &free) {
                // The program created a directory of that name.
                Err(Errno::NOTEMPTY | Errno::EXIST | Errno::NOTDIR) => {}
                moved => return missing_is_fine(moved),
            }
        }
    }

    fn record_error(&mut self, removed: Result<(), Errno>) {
        if let Err(error) = removed {
            self.first_error.get_or_insert(error);
        }
    }
}

/// Removes a file, a link or an empty directory. Returns whether it is gone.
fn remove_simple(directory: &OwnedFd, name: &CStr) -> Result<bool, Errno> {
    match unlinkat(directory, name, AtFlags::empty()) {
        Ok(()) | Err(Errno::NOENT) => return Ok(true),
        Err(Errno::ISDIR | Errno::PERM) => {}
        Err(error) => return Err(error),
    }
    match unlinkat(directory, name, AtFlags::REMOVEDIR) {
        Ok(()) | Err(Errno::NOENT) => Ok(true),
        Err(Errno::NOTEMPTY | Errno::EXIST) => Ok(false),
        Err(error) => Err(error),
    }
}

/// Opens a directory, even if its owner has no permission to.
fn open(parent: impl AsFd, path: impl rustix::path::Arg + Copy) -> Result<OwnedFd, Errno> {
    let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    // Removing entries requires write permission.
    let by_path = OFlags::PATH | OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    let found = openat(&parent, path, by_path, Mode::empty())?;
    let mode = rustix::fs::fstat(&found)?.st_mode;
    if mode & 0o700 != 0o700 {
        chmodat(&parent, path, Mode::RWXU, AtFlags::empty())?;
    }
    openat(&parent, path, flags, Mode::empty())
}

/// Names of the entries of a directory.
fn names(directory: &OwnedFd) -> Result<Vec<CString>, Errno> {
    let mut names = Vec::new();
    for entry in Dir::read_from(directory)? {
        let name = entry?.file_name().to_owned();
        if name.as_bytes() != b"." && name.as_bytes() != b".." {
            names.push(name);
        }
    }
    Ok(names)
}

fn missing_is_fine(result: Result<(), Errno>) -> Result<(), Errno> {
    if result == Err(Errno::NOENT) { Ok(()) } else { result }
}

#[cfg(test)]
mod tests {
    use std::fs::{self, Permissions};
    use std::os::unix::fs::{PermissionsExt, symlink};

    use rustix::fs::mkdirat;

    use super::*;

    /// Creates nested directories whose path exceeds the system's limit.
    fn dig(home: &Path, levels: usize) {
        let mut here = open(CWD, home).unwrap();
        for _ in 0..levels {
            mkdirat(&here, "d", Mode::RWXU).unwrap();
            here = open(&here, "d").unwrap();
        }
    }

    #[test]
    fn trees_of_any_depth_are_removed() {
        let home = tempfile::tempdir().unwrap();
        let root = home.path().join("root");
        fs::create_dir(&root).unwrap();
        dig(&root, 5000);
        for name in ["a", "b"] {
            fs::create_dir_all(root.join(name).join("same/deep")).unwrap();
            fs::write(root.join(name).join("same/deep/file"), "x").unwrap();
        }
        fs::create_dir_all(root.join("calmwalk-moved-1/x")).unwrap();
        fs::create_dir_all(root.join("closed/in")).unwrap();
        fs::write(root.join("closed/in/file"), "x").unwrap();
        fs::set_permissions(root.join("closed/in"), Permissions::from_mode(0o500)).unwrap();
        fs::set_permissions(root.join("closed"), Permissions::from_mode(0o0)).unwrap();
        let kept = home.path().join("kept");
        fs::create_dir(&kept).unwrap();
        symlink(&kept, root.join("link")).unwrap();
        rustix::fs::mkfifoat(CWD, root.join("pipe"), Mode::RUSR).unwrap();
        remove_tree(&root).unwrap();
        assert!(!root.exists() && kept.exists());
        // And once more.
        remove_tree(&root).unwrap();
    }
}
