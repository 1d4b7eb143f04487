//! Directories for calculations that no other user can change.
//!
//! Files in the directory of a calculation are executed as this user, and anybody may write to a directory for
//! temporary files, so an expected name there may belong to another user.

use std::fs::{self, DirBuilder, File};
use std::io::{self, Read};
use std::os::fd::OwnedFd;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};

use rustix::fs::{CWD, Mode, OFlags, Stat, fstat, mkdirat, openat};
use rustix::io::Errno;
use rustix::process::{getegid, geteuid};
use store::StoreError;

use super::file_error::file_error;

/// Random bytes in a name.
const RANDOM_BYTES: usize = 8;
/// Mode bits that permit others to write.
const OTHERS_WRITE: u32 = 0o022;
/// Mode bits that permit others anything.
const OTHERS: u32 = 0o077;
const STICKY: u32 = 0o1000;

/// Why a directory cannot be used.
#[derive(Debug, thiserror::Error)]
pub(super) enum NotPrivate {
    /// Another user could replace a directory created in it.
    #[error(
        "user {owner} owns it and could replace directories in it; expected a directory of user {uid} or of root: choose another \
         label.scratch"
    )]
    OtherOwner { owner: u32, uid: u32 },
    /// Any user could replace a directory created in it.
    #[error(
        "others may write to it (mode {mode:04o}, no sticky bit) and could replace directories in it: make a directory of your \
         own in it with mode 0700, and set label.scratch to it"
    )]
    OpenToOthers { mode: u32 },
    /// Any user could replace a directory above it.
    #[error("others may write to {} (mode {mode:04o}, no sticky bit) and could replace it: choose another label.scratch", path.display())]
    OpenAbove { path: PathBuf, mode: u32 },
    /// A directory created in it has another owner or mode: the file system does not support them.
    #[error(
        "a directory made in it with mode 0700 belongs to user {owner} and has mode {mode:04o}, expected user {uid}: choose a \
         label.scratch on another file system"
    )]
    NotKept { owner: u32, uid: u32, mode: u32 },
    /// Error of the operating system.
    #[error("{0}")]
    Io(#[from] io::Error),
}

impl From<Errno> for NotPrivate {
    fn from(error: Errno) -> Self {
        Self::Io(error.into())
    }
}

/// Creates a directory for this user alone in `parent`, with an unpredictable name: `prefix` and random digits.
/// Creates `parent` if it does not exist.
///
/// # Errors
/// [`NotPrivate`] if another user could change it.
pub(super) fn make(parent: &Path, prefix: &str) -> Result<PathBuf, StoreError> {
    let made = || {
        let above = open_parent(parent)?;
        loop {
            let name = format!("{prefix}{}", random()?);
            match mkdirat(&above, &name, Mode::RWXU) {
                Err(Errno::EXIST) => {}
                made => {
                    made?;
                    check_made(&fstat(&open(&above, name.as_ref())?)?)?;
                    return Ok(parent.join(name));
                }
            }
        }
    };
    made().map_err(|error: NotPrivate| file_error(parent, io::Error::other(error)))
}

/// Checks a directory in which [`make`] is to create others. Creates it if it does not exist.
///
/// # Errors
/// [`NotPrivate`] if another user could change directories in it.
pub(super) fn check(parent: &Path) -> Result<(), StoreError> {
    open_parent(parent).map(drop).map_err(|error| file_error(parent, io::Error::other(error)))
}

/// Creates a directory for this user alone inside one that [`make`] created. `NotFound` if that one was removed.
pub(super) fn make_inside(parent: &Path, name: &str) -> io::Result<PathBuf> {
    let above = open_private(parent)?;
    mkdirat(&above, name, Mode::RWXU)?;
    Ok(parent.join(name))
}

/// Whether this is a directory, not a link, that this user owns and others cannot write to.
pub(super) fn is_ours(path: &Path) -> bool {
    let found = open(CWD, path).and_then(|directory| fstat(&directory));
    found.is_ok_and(|found| found.st_uid == geteuid().as_raw() && found.st_mode & OTHERS_WRITE == 0)
}

/// Whether others cannot read it either.
pub(super) fn is_closed(path: &Path) -> bool {
    open_private(path).is_ok()
}

/// Whether this is a directory, not a link, that this user owns. Inside a directory created by [`make`] no other
/// user can change it, whatever its mode.
pub(super) fn is_own(path: &Path) -> bool {
    let found = open(CWD, path).and_then(|directory| fstat(&directory));
    found.is_ok_and(|found| found.st_uid == geteuid().as_raw())
}

/// Directories in `parent` whose names begin with `prefix`, ordered by name, that only this user can write to.
pub(super) fn ours_in(parent: &Path, prefix: &str) -> io::Result<Vec<PathBuf>> {
    let begins = |path: &PathBuf| {
        path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(prefix.as_bytes()))
    };
    let entries = match fs::read_dir(parent) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries?,
    };
    let mut found: Vec<_> = entries.flatten().map(|entry| entry.path()).filter(begins).collect();
    found.retain(|path| is_ours(path));
    found.sort();
    Ok(found)
}

/// Opens a directory created by [`make`].
fn open_private(path: &Path) -> io::Result<OwnedFd> {
    let directory = open(CWD, path)?;
    match check_made(&fstat(&directory)?) {
        Ok(()) => Ok(directory),
        Err(error) => Err(io::Error::other(error)),
    }
}

fn open(parent: impl std::os::fd::AsFd, path: &Path) -> Result<OwnedFd, Errno> {
    openat(parent, path, OFlags::PATH | OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC, Mode::empty())
}

fn check_made(found: &Stat) -> Result<(), NotPrivate> {
    let (owner, uid, mode) = (found.st_uid, geteuid().as_raw(), found.st_mode & 0o7777);
    match owner == uid && mode & OTHERS == 0 {
        true => Ok(()),
        false => Err(NotPrivate::NotKept { owner, uid, mode }),
    }
}

/// Opens a directory in which directories of this user are safe from other users.
fn open_parent(path: &Path) -> Result<OwnedFd, NotPrivate> {
    DirBuilder::new().recursive(true).mode(0o700).create(path)?;
    // Users may use links to their directories.
    let path = path.canonicalize()?;
    let directory = open(CWD, &path)?;
    let found = fstat(&directory)?;
    let (owner, uid, mode) = (found.st_uid, geteuid().as_raw(), found.st_mode & 0o7777);
    if owner != uid && owner != 0 && !is_unmapped(owner) {
        return Err(NotPrivate::OtherOwner { owner, uid });
    }
    // If each user has a group of its own, directories are often writable for the group.
    let own_group = owner == uid && found.st_gid == getegid().as_raw();
    let open_to = if own_group { 0o002 } else { OTHERS_WRITE };
    if mode & open_to != 0 && mode & STICKY == 0 {
        return Err(NotPrivate::OpenToOthers { mode });
    }
    for above in path.ancestors().skip(1) {
        let mode = above.metadata()?.mode() & 0o7777;
        if mode & 0o002 != 0 && mode & STICKY == 0 {
            return Err(NotPrivate::OpenAbove { path: above.to_owned(), mode });
        }
    }
    Ok(directory)
}

/// Whether this is the owner that an unprivileged container shows for the host's root and for all unknown users.
fn is_unmapped(owner: u32) -> bool {
    let number = |path: &str| fs::read_to_string(path).unwrap_or_default();
    let maps_all = number("/proc/self/uid_map").split_whitespace().eq(["0", "0", "4294967295"]);
    !maps_all && number("/proc/sys/kernel/overflowuid").trim().parse() == Ok(owner)
}

/// Hexadecimal digits from the system's random source.
fn random() -> io::Result<String> {
    let mut bytes = [0; RANDOM_BYTES];
    File::open("/dev/urandom")?.read_exact(&mut bytes)?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

#[cfg(test)]
mod tests {
    use std::fs::Permissions;
    use std::os::unix::fs::{PermissionsExt, chown, symlink};

    use super::*;

    fn mode(path: &Path, mode: u32) {
        fs::set_permissions(path, Permissions::from_mode(mode)).unwrap();
    }

    #[test]
    fn directories_are_private_and_have_unique_names() {
        let scratch = tempfile::tempdir().unwrap();
        let parent = scratch.path().join("new/scratch");
        let (a, b) = (make(&parent, "calmwalk-x-").unwrap(), make(&parent, "calmwalk-x-").unwrap());
        assert!(a != b && is_ours(&a) && is_ours(&b));
        assert_eq!(fs::metadata(&a).unwrap().mode() & 0o7777, 0o700);
        assert_eq!(a.file_name().unwrap().len(), "calmwalk-x-".len() + 2 * RANDOM_BYTES);
        let inside = make_inside(&a, "1-1-0").unwrap();
        assert_eq!(fs::metadata(inside).unwrap().mode() & 0o7777, 0o700);
        let mut both = [a, b];
        both.sort();
        assert_eq!(ours_in(&parent, "calmwalk-x-").unwrap(), both);
        let missing = make_inside(&parent.join("calmwalk-x-none"), "1").unwrap_err();
        assert_eq!(missing.kind(), io::ErrorKind::NotFound);
    }

    #[test]
    fn directories_that_others_could_change_are_refused() {
        let scratch = tempfile::tempdir().unwrap();
        let parent = scratch.path().join("scratch");
        fs::create_dir(&parent).unwrap();
        let refused = || make(&parent, "calmwalk-x-").unwrap_err().to_string();
        mode(&parent, 0o777);
        assert!(
            refused().contains("(mode 0777, no sticky bit) and could replace directories in it"),
            "{}",
            refused()
        );
        mode(&parent, 0o1777);
        make(&parent, "calmwalk-x-").unwrap();
        mode(&parent, 0o755);
        mode(scratch.path(), 0o777);
        assert!(
            refused().contains(&format!("others may write to {}", scratch.path().display())),
            "{}",
            refused()
        );
        mode(scratch.path(), 0o700);
        if geteuid().is_root() {
            chown(&parent, Some(12_345), None).unwrap();
            assert!(refused().contains("user 12345 owns it"), "{}", refused());
        }
    }

    #[test]
    fn directories_of_others_are_not_ours() {
        let scratch = tempfile::tempdir().unwrap();
        let path = make(scratch.path(), "calmwalk-x-").unwrap();
        let link = scratch.path().join("calmwalk-x-link");
        symlink(&path, &link).unwrap();
        assert!(is_ours(&path) && !is_ours(&link) && make_inside(&link, "1").is_err());
        mode(&path, 0o770);
        assert!(!is_ours(&path) && make_inside(&path, "1").is_err());
        mode(&path, 0o700);
        if geteuid().is_root() {
            chown(&path, Some(12_345), None).unwrap();
            assert!(!is_ours(&path) && make_inside(&path, "1").is_err());
        }
        assert_eq!(ours_in(scratch.path(), "calmwalk-x-").unwrap().len(), usize::from(!geteuid().is_root()));
    }
}
