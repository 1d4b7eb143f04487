//! `calmwalk queue DIR files`

use std::fs;
use std::path::{Path, PathBuf};

use store::{Location, Store};

use crate::exit_status::Failure;

/// Writes the packed directories of a candidate's calculations into a directory, one file an attempt. Returns what was
/// written, each with the names of the files that were too large to be kept.
pub async fn write(location: &Location, id: &str, into: &Path) -> Result<Vec<(PathBuf, String)>, Failure> {
    let store = Store::open_read_only(location).await?;
    let job = store.queue_show(id).await?.job;
    let failed = |path: &Path, error| Failure::Failed(format!("cannot write {}: {error}", path.display()));
    fs::create_dir_all(into).map_err(|error| failed(into, error))?;
    let mut written = Vec::new();
    for archive in store.archives(job.job).await? {
        let path = into.join(format!("{}-{}.tar.zst", job.candidate, archive.attempt));
        fs::write(&path, &archive.bytes).map_err(|error| failed(&path, error))?;
        written.push((path, archive.left_out));
    }
    Ok(written)
}
