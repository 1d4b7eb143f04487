//! What a campaign has in shared memory on this host, and how it is wiped.
//!
//! | | |
//! | --- | --- |
//! | `/dev/shm/calmwalk-<uid>/` | this user's campaigns, mode 0700 |
//! | `/dev/shm/calmwalk-<uid>/<name>/` | a campaign: sockets and tables of iceoryx2, the mixture, a file `campaign` that names its directory |
//! | `/dev/shm/cw-<name>-*` | its shared memory segments |
//!
//! `<name>` is a hash of user and campaign directory, so that campaigns do not see each other. All of it is in
//! `/dev/shm` and nothing in `/tmp`, where cleaners remove old files under a campaign that lasts for weeks. It is short
//! because the path of a socket has at most 107 bytes.

use std::ffi::OsStr;
use std::fs::{self, DirBuilder, Metadata, Permissions};
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

const SHARED_MEMORY: &str = "/dev/shm";
/// The file that names the campaign's directory.
const CAMPAIGN: &str = "campaign";
const MIXTURE: &str = "mixture";
/// Hexadecimal digits of a name.
const DIGITS: usize = 16;

/// The place of one campaign.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    directory: PathBuf,
    prefix: String,
    campaign: Option<PathBuf>,
}

/// What was removed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Removed {
    /// Files, directories not counted.
    pub files: usize,
    /// Bytes of memory that they held.
    pub bytes: u64,
}

/// Why a place cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum PlaceError {
    /// The operating system says no.
    #[error("cannot {what} {}: {source}", path.display())]
    Io {
        /// What was tried.
        what: &'static str,
        /// With which file.
        path: PathBuf,
        /// What came of it.
        source: io::Error,
    },
    /// Somebody else made it, or others may write to it.
    #[error(
        "{} {found}, expected a directory of user {uid} with mode 0700: whoever made it must remove it, \
         or use `--in-process`",
        path.display()
    )]
    NotOurs {
        /// The directory.
        path: PathBuf,
        /// What it is instead.
        found: String,
        /// This user.
        uid: u32,
    },
    /// Shared memory is too small. Going on would end with SIGBUS in the middle of a write.
    #[error(
        "the campaign needs {} of shared memory and /dev/shm has {} free: enlarge /dev/shm (in a container \
         `--shm-size`), use fewer walkers, or use `--in-process`; `calmwalk clean` removes what dead campaigns left",
        megabytes(*needed),
        megabytes(*free)
    )]
    Space {
        /// Bytes.
        needed: u64,
        /// Bytes.
        free: u64,
    },
}

fn megabytes(bytes: u64) -> String {
    format!("{:.1} MB", bytes as f64 / 1e6)
}

impl Place {
    /// The place of the campaign in `campaign_directory`, which must exist. Nothing is created.
    ///
    /// # Errors
    /// A directory that does not exist.
    pub fn of(campaign_directory: &Path) -> Result<Self, PlaceError> {
        let path = fs::canonicalize(campaign_directory).map_err(io_error("find", campaign_directory))?;
        let mut hasher = blake3::Hasher::new();
        hasher.update(&user().to_le_bytes());
        hasher.update(path.as_os_str().as_bytes());
        let hash = hasher.finalize().to_hex();
        Ok(Self { campaign: Some(path), ..Self::named(&hash[..DIGITS]) })
    }

    fn named(name: &str) -> Self {
        let directory = home().join(name);
        let campaign = fs::read(directory.join(CAMPAIGN)).ok();
        let campaign = campaign.map(|path| PathBuf::from(OsStr::from_bytes(&path)));
        Self { directory, prefix: format!("cw-{name}-"), campaign }
    }

    /// Every place of this user on this host, of live and dead campaigns.
    ///
    /// # Errors
    /// Directories that cannot be read.
    pub fn all() -> Result<Vec<Self>, PlaceError> {
        let mut names = Vec::new();
        for entry in entries(&home())? {
            names.extend(entry.file_name().and_then(OsStr::to_str).map(str::to_owned));
        }
        // Segments whose directory is gone.
        for path in segments("cw-")? {
            let name = path.file_name().and_then(OsStr::to_str).and_then(|name| name.strip_prefix("cw-"));
            names.extend(name.and_then(|name| name.split('-').next()).map(str::to_owned));
        }
        names.retain(|name| name.len() == DIGITS && name.bytes().all(|b| b.is_ascii_hexdigit()));
        names.sort_unstable();
        names.dedup();
        Ok(names.iter().map(|name| Self::named(name)).collect())
    }

    /// The directory, for sockets, tables and the mixture.
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    /// The file of the shared mixture.
    pub fn mixture(&self) -> PathBuf {
        self.directory.join(MIXTURE)
    }

    /// What the names of the campaign's segments in `/dev/shm` begin with.
    pub fn prefix(&self) -> &str {
        &self.prefix
    }

    /// The campaign's directory; `None` of a place from [`Place::all`] in which no file says so any more.
    pub fn campaign_directory(&self) -> Option<&Path> {
        self.campaign.as_deref()
    }

    /// Makes the place ready: removes what dead processes left, makes the directory, and checks that `needed` bytes are
    /// free. The caller holds the campaign's lock, so that nobody is there.
    ///
    /// # Errors
    /// Files of somebody else, too little space.
    pub fn prepare(&self, needed: u64) -> Result<Removed, PlaceError> {
        let removed = self.wipe()?;
        let free = free_space()?;
        if free < needed {
            return Err(PlaceError::Space { needed, free });
        }
        // Twice, because another campaign that ends may just remove the empty directory above.
        self.make().or_else(|_| self.make())?;
        if let Some(campaign) = &self.campaign {
            let file = self.directory.join(CAMPAIGN);
            fs::write(&file, campaign.as_os_str().as_bytes()).map_err(io_error("write", &file))?;
        }
        Ok(removed)
    }

    fn make(&self) -> Result<(), PlaceError> {
        make_private(&home(), user())?;
        make_private(&self.directory, user())
    }

    /// Takes from others the right to read and write the campaign's segments, which iceoryx2 gives them for one of them
    /// (a counter of processes).
    pub(crate) fn close_to_others(&self) -> Result<(), PlaceError> {
        for path in segments(&self.prefix)? {
            let mode = path.symlink_metadata().map_err(io_error("look at", &path))?.mode();
            if mode & 0o077 != 0 {
                let private = Permissions::from_mode(mode & 0o700);
                fs::set_permissions(&path, private).map_err(io_error("change the mode of", &path))?;
            }
        }
        Ok(())
    }

    /// Removes everything of this campaign. No process of it may be alive.
    ///
    /// # Errors
    /// Files of somebody else.
    pub fn remove(&self) -> Result<Removed, PlaceError> {
        let removed = self.wipe()?;
        // Other campaigns may have theirs there.
        let _ = fs::remove_dir(home());
        Ok(removed)
    }

    fn wipe(&self) -> Result<Removed, PlaceError> {
        let mut removed = Removed::default();
        if home().symlink_metadata().is_ok() {
            check_private(&home(), user())?;
            remove_tree(&self.directory, &mut removed)?;
        }
        for path in segments(&self.prefix)? {
            remove_file(&path, &mut removed)?;
        }
        Ok(removed)
    }
}

/// The directory of this user's places.
fn home() -> PathBuf {
    Path::new(SHARED_MEMORY).join(format!("calmwalk-{}", user()))
}

fn user() -> u32 {
    rustix::process::geteuid().as_raw()
}

/// Bytes that may still be written to shared memory.
pub(crate) fn free_space() -> Result<u64, PlaceError> {
    let statistics = rustix::fs::statvfs(SHARED_MEMORY)
        .map_err(|source| io_error("ask for the free space of", Path::new(SHARED_MEMORY))(source.into()))?;
    Ok(statistics.f_bavail.saturating_mul(statistics.f_frsize))
}

/// This user's files in `/dev/shm` whose names begin with `prefix`.
fn segments(prefix: &str) -> Result<Vec<PathBuf>, PlaceError> {
    let mut paths = entries(Path::new(SHARED_MEMORY))?;
    paths.retain(|path| {
        let ours = path.symlink_metadata().is_ok_and(|file| file.uid() == user() && !file.is_dir());
        ours && path.file_name().is_some_and(|name| name.as_bytes().starts_with(prefix.as_bytes()))
    });
    Ok(paths)
}

/// What is in a directory; nothing if there is no such directory.
fn entries(directory: &Path) -> Result<Vec<PathBuf>, PlaceError> {
    let listed = match fs::read_dir(directory) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        listed => listed.map_err(io_error("list", directory))?,
    };
    listed.map(|entry| entry.map(|entry| entry.path()).map_err(io_error("list", directory))).collect()
}

fn remove_tree(path: &Path, removed: &mut Removed) -> Result<(), PlaceError> {
    match path.symlink_metadata() {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(io_error("look at", path)(error)),
        Ok(found) if found.is_dir() => {
            entries(path)?.iter().try_for_each(|entry| remove_tree(entry, removed))?;
            missing_is_fine(fs::remove_dir(path)).map_err(io_error("remove", path))
        }
        Ok(_) => remove_file(path, removed),
    }
}

fn remove_file(path: &Path, removed: &mut Removed) -> Result<(), PlaceError> {
    let blocks = path.symlink_metadata().map_or(0, |file| file.blocks());
    missing_is_fine(fs::remove_file(path)).map_err(io_error("remove", path))?;
    removed.files += 1;
    removed.bytes += 512 * blocks;
    Ok(())
}

fn missing_is_fine(result: io::Result<()>) -> io::Result<()> {
    if result.as_ref().is_err_and(|error| error.kind() == io::ErrorKind::NotFound) { Ok(()) } else { result }
}

/// Makes a directory for this user alone, or checks that the one that is there is such a directory.
fn make_private(path: &Path, uid: u32) -> Result<(), PlaceError> {
    match DirBuilder::new().mode(0o700).create(path) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
        made => made.map_err(io_error("make", path))?,
    }
    check_private(path, uid)
}

/// Everybody may write to `/dev/shm`: what has the right name may be a trap.
fn check_private(path: &Path, uid: u32) -> Result<(), PlaceError> {
    let found = path.symlink_metadata().map_err(io_error("look at", path))?;
    if found.is_dir() && found.uid() == uid && found.mode() & 0o777 == 0o700 {
        return Ok(());
    }
    Err(PlaceError::NotOurs { path: path.to_owned(), found: describe(&found), uid })
}

fn describe(found: &Metadata) -> String {
    let kind = if found.is_dir() { "a directory" } else { "no directory" };
    format!("is {kind} of user {} with mode {:04o}", found.uid(), found.mode() & 0o7777)
}

fn io_error(what: &'static str, path: &Path) -> impl FnOnce(io::Error) -> PlaceError {
    move |source| PlaceError::Io { what, path: path.to_owned(), source }
}

#[cfg(test)]
mod tests {
    use std::iter::repeat_n;
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn a_directory_that_others_made_or_may_write_to_is_refused() {
        let here = tempfile::tempdir().unwrap();
        let path = here.path().join("home");
        make_private(&path, user()).unwrap();
        make_private(&path, user()).unwrap();

        let message = check_private(&path, user() + 1).unwrap_err().to_string();
        assert!(message.contains(&format!("a directory of user {} with mode 0700", user())), "{message}");
        fs::set_permissions(&path, Permissions::from_mode(0o770)).unwrap();
        let message = make_private(&path, user()).unwrap_err().to_string();
        assert!(message.contains("with mode 0770"), "{message}");

        let link = here.path().join("link");
        fs::set_permissions(&path, Permissions::from_mode(0o700)).unwrap();
        symlink(&path, &link).unwrap();
        let message = make_private(&link, user()).unwrap_err().to_string();
        assert!(message.contains("no directory"), "{message}");
    }

    /// `sockaddr_un` has room for 108 bytes with the zero at the end.
    #[test]
    fn the_longest_path_of_a_socket_is_short_enough() {
        let home = format!("{SHARED_MEMORY}/calmwalk-{}", u32::MAX);
        let name: String = repeat_n('f', DIGITS).collect();
        let path = format!("{home}/{name}/{}{}.e", Place::named(&name).prefix, u128::MAX);
        assert_eq!(path.len(), 107);
    }
}
