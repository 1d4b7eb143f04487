//! The directories of calculations: what becomes of them.

use std::fs;
use std::path::Path;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use store::{Store, StoreError};

use super::begun::{Begun, Found};
use super::code::{blocking, file};
use super::here;
use super::running::Keep;
use super::slurm::Slurm;
use super::{Closing, insist, pack};

/// What was left behind is only cleared away when nobody can still be at it.
const AGE: Duration = Duration::from_secs(60);

/// Name of the directory of a calculation. No two are alike, also if the campaign has copies.
pub(super) fn name(job: i64, attempt: u32) -> String {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    format!("{job}-{attempt}-{:x}", now.as_nanos())
}

/// Packs a directory into the store.
pub(super) async fn pack(
    store: &Store,
    job: i64,
    attempt: u32,
    closing: &Closing,
    directory: &Path,
) -> Result<(), StoreError> {
    let from = directory.to_owned();
    let packed = blocking(move || pack::pack(&from)).await.map_err(|error| file(directory, error))?;
    insist(closing, || store.keep_archive(job, attempt, &packed.bytes, &packed.left_out)).await
}

/// Clears away the directories that killed labellers have left in `home`, as far as nobody needs them: those of
/// calculations whose keeper is gone and whose job waits for nothing.
pub(super) async fn tidy(
    store: &Store,
    home: &Path,
    keep: Keep,
    slurm: &Slurm,
    closing: &Closing,
) -> Result<(), StoreError> {
    let entries = fs::read_dir(home).map_err(|error| file(home, error))?;
    for directory in entries.flatten().map(|entry| entry.path()).filter(|path| is_old(path)) {
        let Some((job, attempt)) = numbers(&directory) else { continue };
        let past = insist(closing, || store.past_calculation(job, attempt)).await?;
        // Of a copy of this campaign.
        let Some(past) = past.filter(|past| !past.wanted) else { continue };
        let begun = past.calculation.as_deref().and_then(Begun::parse);
        let is_over = match begun.filter(|begun| begun.directory() == directory) {
            Some(begun) => !matches!(begun.look(slurm).await?, Found::Running),
            // Whoever made it was killed before anything began.
            None => true,
        };
        if is_over && keep.keeps(past.failed) {
            self::pack(store, job, attempt, closing, &directory).await?;
        }
        if is_over {
            let cleared = directory.clone();
            blocking(move || here::clear(&cleared)).await.map_err(|error| file(&directory, error))?;
        }
    }
    Ok(())
}

/// Job and attempt of the directory of that name.
fn numbers(directory: &Path) -> Option<(i64, u32)> {
    let mut parts = directory.file_name()?.to_str()?.splitn(3, '-');
    Some((parts.next()?.parse().ok()?, parts.next()?.parse().ok()?))
}

fn is_old(directory: &Path) -> bool {
    let changed = fs::metadata(directory).and_then(|directory| directory.modified());
    changed.is_ok_and(|changed| changed.elapsed().is_ok_and(|age| age > AGE))
}
