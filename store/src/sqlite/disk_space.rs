//! Checks the disk space needed to rewrite a database.

use std::env;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use crate::error::{Result, StoreError};
use crate::filesystem::free_space;

/// Checks that `bytes` are free for SQLite's temporary files, and as many beside `database` for its log.
pub(super) fn check(database: &Path, bytes: u64) -> Result<()> {
    let beside = database.parent().unwrap_or(Path::new("."));
    let temporary = temporary_directory();
    let device = |path: &Path| path.metadata().map(|file| file.dev()).ok();
    let together = device(beside) == device(&temporary);
    let needs = if together { vec![(beside, 2 * bytes)] } else { vec![(beside, bytes), (&temporary, bytes)] };
    for (directory, needed) in needs {
        let found = free_space(directory)?;
        if found < needed {
            return Err(StoreError::InsufficientSpace { directory: directory.into(), found, needed });
        }
    }
    Ok(())
}

/// SQLite's directory for temporary files, https://www.sqlite.org/tempfiles.html
fn temporary_directory() -> PathBuf {
    let named = ["SQLITE_TMPDIR", "TMPDIR"].into_iter().filter_map(env::var_os).map(PathBuf::from);
    let known = ["/var/tmp", "/usr/tmp", "/tmp", "."].into_iter().map(PathBuf::from);
    named.chain(known).find(|directory| directory.is_dir()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_disk_space_is_reported_with_both_numbers() {
        let directory = tempfile::tempdir().unwrap();
        let database = directory.path().join("campaign.sqlite");
        check(&database, 1000).unwrap();
        let error = check(&database, 1 << 60).unwrap_err();
        assert!(
            matches!(error, StoreError::InsufficientSpace { needed, .. } if needed >= 1 << 60),
            "{error}"
        );
        assert!(error.to_string().contains(" MB free, and rewriting the database needs "), "{error}");
    }
}
