//! `calmwalk queue DIR files`

use std::fs;
use std::path::{Path, PathBuf};

use store::{Location, Store};

use crate::exit_status::CommandError;

/// Writes the archived calculation directories of a candidate to `output`, one file per attempt. Returns the paths, each with
/// the names of the files that were too large to archive.
pub async fn write(
    location: &Location,
    id: &str,
    output: &Path,
) -> Result<Vec<(PathBuf, String)>, CommandError> {
    let store = Store::open_read_only(location).await?;
    let job = store.queue_show(id).await?.job;
    let failed =
        |path: &Path, error| CommandError::Failed(format!("cannot write {}: {error}", path.display()));
    fs::create_dir_all(output).map_err(|error| failed(output, error))?;
    let mut written = Vec::new();
    for archive in store.archives(job.job).await? {
        let path = output.join(format!("{}-{}.tar.zst", job.candidate, archive.attempt));
        fs::write(&path, &archive.bytes).map_err(|error| failed(&path, error))?;
        written.push((path, archive.left_out));
    }
    Ok(written)
}
