//! Removing the directory of a calculation.
//!
//! That takes a while, in which a labeller may be killed, and files that a node still uses stay. What is left must not be taken for a
//! calculation: without the mark of its begin and its recorded end, a directory looks like one that is ready to start. It therefore
//! gets another name first.

use std::fs;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

use super::remove_tree::remove_tree;

/// End of the names of directories that are being removed.
const REMOVED: &str = "-removed";

/// Removes a directory with its content, and what an earlier removal left of it. A missing directory is no error.
///
/// # Errors
/// It cannot be renamed, and then nothing is removed; or the first entry that cannot be removed.
pub(super) fn remove_directory(directory: &Path) -> io::Result<()> {
    remove_directory_by(directory, remove_tree)
}

fn remove_directory_by(directory: &Path, remove: impl FnOnce(&Path) -> io::Result<()>) -> io::Result<()> {
    if is_being_removed(directory) {
        return remove(directory);
    }
    let renamed = renamed(directory);
    match fs::rename(directory, &renamed) {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(error),
        _ => remove(&renamed),
    }
}

/// Whether this is what a removal left.
pub(super) fn is_being_removed(directory: &Path) -> bool {
    directory.file_name().is_some_and(|name| name.as_encoded_bytes().ends_with(REMOVED.as_bytes()))
}

fn renamed(directory: &Path) -> PathBuf {
    let mut path = directory.as_os_str().to_owned();
    path.push(REMOVED);
    path.into()
}

#[cfg(test)]
mod tests {
    use super::super::slurm::JobDirectory;
    use super::*;

    /// A labeller that is killed during the removal leaves the request and the script, and neither begin nor end.
    #[test]
    fn what_is_left_of_a_removal_is_no_calculation_that_is_ready() {
        let home = tempfile::tempdir().unwrap();
        let directory = home.path().join("1-1-0");
        fs::create_dir_all(directory.join("begun")).unwrap();
        for file in ["job.sh", "order.json"] {
            fs::write(directory.join(file), "x").unwrap();
        }
        let look = || JobDirectory::look(&directory);
        assert!(matches!(look(), JobDirectory::Own { begun: true, .. }));
        let killed = |path: &Path| {
            fs::remove_dir(path.join("begun"))?;
            Err(io::Error::other("killed"))
        };
        remove_directory_by(&directory, killed).unwrap_err();
        assert_eq!(look(), JobDirectory::Missing);
        // A second removal, by either name, removes what is left.
        let left = home.path().join("1-1-0-removed");
        assert!(left.is_dir() && is_being_removed(&left) && !is_being_removed(&directory));
        remove_directory(&directory).unwrap();
        assert!(!left.exists());
        fs::create_dir_all(left.join("work")).unwrap();
        remove_directory(&left).unwrap();
        assert_eq!(fs::read_dir(home.path()).unwrap().count(), 0);
        remove_directory(&directory).unwrap();
    }
}
