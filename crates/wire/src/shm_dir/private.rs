//! Directories that only this user can access.

use std::fs::{self, DirBuilder, Metadata, Permissions};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use super::error::{ShmDirError, io_error};

/// Where the kernel keeps shared memory.
pub(super) const SHARED_MEMORY: &str = "/dev/shm";

pub(super) fn user() -> u32 {
    rustix::process::geteuid().as_raw()
}

/// The parent of all directories of this user.
pub(super) fn user_root() -> PathBuf {
    Path::new(SHARED_MEMORY).join(format!("calmwalk-{}", user()))
}

/// Creates a directory with mode 0700, or checks that the existing one has it.
pub(super) fn create_private(path: &Path, uid: u32) -> Result<(), ShmDirError> {
    match DirBuilder::new().mode(0o700).create(path) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
        // Whatever the umask is: iceoryx2 changes that of the process for a moment.
        Ok(()) => {
            fs::set_permissions(path, Permissions::from_mode(0o700)).map_err(io_error("create", path))?
        }
        Err(error) => return Err(io_error("create", path)(error)),
    }
    check_private(path, uid)
}

/// All users may write to `/dev/shm`, so an existing directory may belong to an attacker.
pub(super) fn check_private(path: &Path, uid: u32) -> Result<(), ShmDirError> {
    let found = path.symlink_metadata().map_err(io_error("inspect", path))?;
    if found.is_dir() && found.uid() == uid && found.mode() & 0o777 == 0o700 {
        return Ok(());
    }
    Err(ShmDirError::NotPrivate { path: path.to_owned(), found: describe(&found), uid })
}

fn describe(found: &Metadata) -> String {
    let kind = if found.is_dir() { "a directory" } else { "no directory" };
    format!("is {kind} of user {} with mode {:04o}", found.uid(), found.mode() & 0o7777)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn directories_of_other_users_or_with_wrong_modes_are_rejected() {
        let here = tempfile::tempdir().unwrap();
        let path = here.path().join("home");
        create_private(&path, user()).unwrap();
        create_private(&path, user()).unwrap();

        let message = check_private(&path, user() + 1).unwrap_err().to_string();
        assert!(message.contains(&format!("a directory of user {} with mode 0700", user())), "{message}");
        fs::set_permissions(&path, Permissions::from_mode(0o770)).unwrap();
        let message = create_private(&path, user()).unwrap_err().to_string();
        assert!(message.contains("with mode 0770"), "{message}");

        let link = here.path().join("link");
        fs::set_permissions(&path, Permissions::from_mode(0o700)).unwrap();
        symlink(&path, &link).unwrap();
        let message = create_private(&link, user()).unwrap_err().to_string();
        assert!(message.contains("no directory"), "{message}");
    }
}
