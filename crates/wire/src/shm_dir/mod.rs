//! Shared memory of a campaign on this host, and its cleanup.
//!
//! | | |
//! | --- | --- |
//! | `/dev/shm/calmwalk-<uid>/` | this user's campaigns, mode 0700 |
//! | `/dev/shm/calmwalk-<uid>/<name>/` | a campaign: sockets and tables of iceoryx2, the mixture, a file `campaign` with the path of its directory |
//! | `/dev/shm/cw-<name>-*` | its shared memory segments |
//!
//! `<name>` is a hash of user and campaign directory, which separates campaigns. It is short because the path of a
//! socket has at most 107 bytes. Everything is in `/dev/shm` and nothing in `/tmp`, where cleaners would remove files
//! of a campaign that lasts for weeks.
//!
//! A run locks its directory (see [`lock`]), so that no other process removes it.

mod error;
mod files;
mod lock;
mod private;

use std::ffi::OsStr;
use std::fs::{self, OpenOptions, Permissions};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{FallocateFlags, fallocate};
use rustix::io::{Errno, retry_on_intr};

pub use error::ShmDirError;
pub use files::Removed;

use error::io_error;
use files::{count_file, count_tree, entries, remove_file, remove_tree};
use lock::{DirLock, UserLock};
use private::{SHARED_MEMORY, create_private, user, user_root};

/// The file with the path of the campaign's directory.
const CAMPAIGN: &str = "campaign";
const MIXTURE: &str = "mixture";
/// Length of a name, hexadecimal digits.
const DIGITS: usize = 16;

/// The shared memory directory of a campaign.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ShmDir {
    directory: PathBuf,
    prefix: String,
    campaign: Option<PathBuf>,
}

/// A prepared directory, locked by this process until this value is dropped.
#[derive(Debug)]
pub struct PreparedDir {
    /// What was removed of dead processes.
    pub removed: Removed,
    _lock: DirLock,
}

impl ShmDir {
    /// The directory of the campaign in `campaign_directory`, which must exist. Creates nothing.
    ///
    /// # Errors
    /// The directory does not exist.
    pub fn for_campaign(campaign_directory: &Path) -> Result<Self, ShmDirError> {
        let path = fs::canonicalize(campaign_directory).map_err(io_error("find", campaign_directory))?;
        let mut hasher = blake3::Hasher::new();
        hasher.update(&user().to_le_bytes());
        hasher.update(path.as_os_str().as_bytes());
        let hash = hasher.finalize().to_hex();
        Ok(Self { campaign: Some(path), ..Self::from_name(&hash[..DIGITS]) })
    }

    fn from_name(name: &str) -> Self {
        let directory = user_root().join(name);
        let campaign = fs::read(directory.join(CAMPAIGN)).ok();
        let campaign = campaign.map(|path| PathBuf::from(OsStr::from_bytes(&path)));
        Self { directory, prefix: format!("cw-{name}-"), campaign }
    }

    /// All directories of this user on this host, of live and dead campaigns.
    ///
    /// # Errors
    /// A directory cannot be read.
    pub fn all() -> Result<Vec<Self>, ShmDirError> {
        let mut names = Vec::new();
        for entry in entries(&user_root())? {
            names.extend(entry.file_name().and_then(OsStr::to_str).map(str::to_owned));
        }
        // Segments without a directory.
        for path in segments("cw-")? {
            let name = path.file_name().and_then(OsStr::to_str).and_then(|name| name.strip_prefix("cw-"));
            names.extend(name.and_then(|name| name.split('-').next()).map(str::to_owned));
        }
        names.retain(|name| name.len() == DIGITS && name.bytes().all(|b| b.is_ascii_hexdigit()));
        names.sort_unstable();
        names.dedup();
        Ok(names.iter().map(|name| Self::from_name(name)).collect())
    }

    /// The directory with sockets, tables and the mixture.
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    /// Path of the shared mixture.
    pub fn mixture(&self) -> PathBuf {
        self.directory.join(MIXTURE)
    }

    /// Prefix of the names of the campaign's segments in `/dev/shm`.
    pub fn prefix(&self) -> &str {
        &self.prefix
    }

    /// The campaign's directory; `None` for a directory from [`ShmDir::all`] without a `campaign` file.
    pub fn campaign_directory(&self) -> Option<&Path> {
        self.campaign.as_deref()
    }

    /// Prepares the directory: removes what dead processes left, creates and locks the directory, and checks that
    /// `needed` bytes are free. No other process can prepare or remove it while the returned value lives.
    ///
    /// # Errors
    /// A run is active, a file belongs to another user, or there is not enough space.
    pub fn prepare(&self, needed: u64) -> Result<PreparedDir, ShmDirError> {
        let _user_lock = UserLock::wait()?;
        let removed = self.wipe()?;
        let free = free_space()?;
        if free < needed {
            return Err(ShmDirError::Space { needed, free });
        }
        create_private(&self.directory, user())?;
        let lock = self.lock()?;
        if let Some(campaign) = &self.campaign {
            let file = self.directory.join(CAMPAIGN);
            fs::write(&file, campaign.as_os_str().as_bytes()).map_err(io_error("write", &file))?;
        }
        Ok(PreparedDir { removed, _lock: lock })
    }

    /// Removes the permissions of other users on the campaign's segments. iceoryx2 grants them for one segment, a
    /// counter of processes.
    pub(crate) fn restrict_permissions(&self) -> Result<(), ShmDirError> {
        for path in segments(&self.prefix)? {
            let mode = path.symlink_metadata().map_err(io_error("inspect", &path))?.mode();
            if mode & 0o077 != 0 {
                let private = Permissions::from_mode(mode & 0o700);
                fs::set_permissions(&path, private).map_err(io_error("change the mode of", &path))?;
            }
        }
        Ok(())
    }

    /// Removes all shared memory of this campaign, unless a run is active.
    ///
    /// # Errors
    /// A run is active ([`ShmDirError::InUse`]), or a file belongs to another user.
    pub fn remove(&self) -> Result<Removed, ShmDirError> {
        let _user_lock = UserLock::wait()?;
        self.wipe()
    }

    /// What [`Self::remove`] would remove.
    ///
    /// # Errors
    /// As [`Self::remove`].
    pub fn removable(&self) -> Result<Removed, ShmDirError> {
        let (_user_lock, mut found) = (UserLock::wait()?, Removed::default());
        if self.directory.symlink_metadata().is_ok() {
            let _lock = self.lock()?;
            count_tree(&self.directory, &mut found)?;
        }
        segments(&self.prefix)?.iter().for_each(|path| count_file(path, &mut found));
        Ok(found)
    }

    fn lock(&self) -> Result<DirLock, ShmDirError> {
        DirLock::take(&self.directory, self.campaign_directory())
    }

    fn wipe(&self) -> Result<Removed, ShmDirError> {
        let mut removed = Removed::default();
        if self.directory.symlink_metadata().is_ok() {
            let _lock = self.lock()?;
            remove_tree(&self.directory, &mut removed)?;
        }
        for path in segments(&self.prefix)? {
            remove_file(&path, &mut removed)?;
        }
        Ok(removed)
    }
}

/// Free shared memory, bytes.
pub(crate) fn free_space() -> Result<u64, ShmDirError> {
    let statistics = rustix::fs::statvfs(SHARED_MEMORY)
        .map_err(|source| io_error("query the free space of", Path::new(SHARED_MEMORY))(source.into()))?;
    Ok(statistics.f_bavail.saturating_mul(statistics.f_frsize))
}

/// Reserves the memory of the campaign's segments, or only of one iceoryx2 port, whose number is part of their names.
/// Segments are created sparse; without reservation, a write could fail with SIGBUS.
pub(crate) fn reserve(prefix: &str, port: Option<u128>) -> Result<(), ShmDirError> {
    let port = port.map_or_else(String::new, |port| format!("_{port}"));
    for path in segments(prefix)? {
        if path.to_str().is_some_and(|path| path.contains(&port)) {
            reserve_file(&path)?;
        }
    }
    Ok(())
}

fn reserve_file(path: &Path) -> Result<(), ShmDirError> {
    let file = OpenOptions::new().write(true).open(path).map_err(io_error("open", path))?;
    let needed = file.metadata().map_err(io_error("inspect", path))?.len();
    match retry_on_intr(|| fallocate(&file, FallocateFlags::empty(), 0, needed)) {
        Ok(()) => Ok(()),
        Err(Errno::NOSPC) => Err(ShmDirError::Space { needed, free: free_space()? }),
        Err(error) => Err(io_error("reserve the memory of", path)(error.into())),
    }
}

/// This user's files in `/dev/shm` with this prefix.
fn segments(prefix: &str) -> Result<Vec<PathBuf>, ShmDirError> {
    let mut paths = entries(Path::new(SHARED_MEMORY))?;
    paths.retain(|path| {
        let ours = path.symlink_metadata().is_ok_and(|file| file.uid() == user() && !file.is_dir());
        ours && path.file_name().is_some_and(|name| name.as_bytes().starts_with(prefix.as_bytes()))
    });
    Ok(paths)
}

#[cfg(test)]
mod tests {
    use std::iter::repeat_n;

    use super::*;

    /// `sockaddr_un` has 108 bytes including the terminating zero.
    #[test]
    fn the_longest_path_of_a_socket_is_short_enough() {
        let home = format!("{SHARED_MEMORY}/calmwalk-{}", u32::MAX);
        let name: String = repeat_n('f', DIGITS).collect();
        let path = format!("{home}/{name}/{}{}.e", ShmDir::from_name(&name).prefix, u128::MAX);
        assert_eq!(path.len(), 107);
    }
}
