//! Directories of calculations: creating, archiving and removing them.
//!
//! | | |
//! | --- | --- |
//! | `<scratch>/calmwalk-<campaign>-<random>/` | directory of a campaign, for this user alone (see [`private_directory`]); later labellers find it by name and owner |
//! | `<scratch>/calmwalk-<campaign>-<random>/<job>-<attempt>-<time>/` | directory of a calculation, with the folders `work` and `data`; with `-removed` at its end while it is removed |

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use store::{PastCalculation, Store, StoreError};
use tokio_util::sync::CancellationToken;
use wire::CampaignId;

use super::batch_access::BatchAccess;
use super::blocking::blocking;
use super::calculation_handle::CalculationHandle;
use super::calculation_state::CalculationState;
use super::execution::KeepDirectories;
use super::file_error::file_error;
use super::removal::is_being_removed;
use super::slurm;
use super::{local, pack, private_directory, retry_until_written};

/// Directories younger than this may still be in use and are not removed.
const MIN_AGE: Duration = Duration::from_secs(60);
/// Tries to create a directory while another process removes empty ones.
const MAX_ATTEMPTS: u32 = 100;

/// The directory for all calculations of a campaign by this user, below the scratch directory.
#[derive(Debug)]
pub(super) struct ScratchRoot {
    scratch: PathBuf,
    /// Prefix of its name. Several labellers that start at the same time may create one each.
    prefix: String,
}

impl ScratchRoot {
    /// The scratch root of a campaign.
    pub fn for_campaign(scratch: &Path, campaign: CampaignId) -> Self {
        Self { scratch: scratch.to_owned(), prefix: format!("calmwalk-{campaign}") }
    }

    /// Creates a directory for calculations if there is none.
    ///
    /// # Errors
    /// No directory can be created that is safe from other users.
    pub fn prepare(&self) -> Result<PathBuf, StoreError> {
        private_directory::check(&self.scratch)?;
        let prefix = format!("{}-", self.prefix);
        let found = private_directory::ours_in(&self.scratch, &prefix)
            .map_err(|error| file_error(&self.scratch, error))?;
        match found.into_iter().find(|path| private_directory::is_closed(path)) {
            Some(root) => Ok(root),
            None => private_directory::make(&self.scratch, &prefix),
        }
    }

    /// Creates the directory of a calculation.
    ///
    /// # Errors
    /// The same.
    pub fn make(&self, job: i64, attempt: u32) -> Result<PathBuf, StoreError> {
        let mut tries = 0;
        loop {
            let root = self.prepare()?;
            tries += 1;
            match private_directory::make_inside(&root, &name(job, attempt)) {
                // The process that ended last has removed it.
                Err(error) if error.kind() == io::ErrorKind::NotFound && tries < MAX_ATTEMPTS => {}
                made => return made.map_err(|error| file_error(&root, error)),
            }
        }
    }

    /// Removes directories that killed labellers left and that are not needed: those of calculations whose runner has
    /// ended and whose result is not wanted, and those of which they had begun to remove.
    pub async fn cleanup(
        &self,
        store: &Store,
        keep: KeepDirectories,
        batch: &BatchAccess,
        stop: &CancellationToken,
    ) -> Result<(), StoreError> {
        for root in self.all()? {
            let entries = fs::read_dir(&root).map_err(|error| file_error(&root, error))?;
            for directory in entries.flatten().map(|entry| entry.path()).filter(|path| is_old(path)) {
                cleanup_one(store, &directory, keep, batch, stop).await?;
            }
        }
        Ok(())
    }

    /// Removes directories without calculations.
    pub fn remove_empty(&self) {
        for root in self.all().unwrap_or_default() {
            remove_empty(&root);
        }
    }

    /// All directories of this campaign, including those of earlier versions of this program.
    fn all(&self) -> Result<Vec<PathBuf>, StoreError> {
        private_directory::ours_in(&self.scratch, &self.prefix)
            .map_err(|error| file_error(&self.scratch, error))
    }
}

/// Removes the directory of a campaign if it holds no calculations.
pub(super) fn remove_empty(root: &Path) {
    let is_calculation = |path: &Path| job_and_attempt(path).is_some();
    let entries = fs::read_dir(root).into_iter().flatten().flatten();
    if !entries.map(|entry| entry.path()).any(|path| is_calculation(&path)) {
        slurm::remove_cache(root);
        // Another labeller may be creating one there.
        let _ = fs::remove_dir(root);
    }
}

/// Directory name of a calculation. It is unique even if the campaign was copied.
pub(super) fn name(job: i64, attempt: u32) -> String {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    format!("{job}-{attempt}-{:x}", now.as_nanos())
}

/// Packs a directory into the store.
pub(super) async fn pack(
    store: &Store,
    job: i64,
    attempt: u32,
    stop: &CancellationToken,
    directory: &Path,
) -> Result<(), StoreError> {
    let from = directory.to_owned();
    let packed = blocking(move || pack::pack(&from)).await.map_err(|error| file_error(directory, error))?;
    retry_until_written(stop, || store.keep_archive(job, attempt, &packed.bytes, &packed.left_out)).await
}

async fn cleanup_one(
    store: &Store,
    directory: &Path,
    keep: KeepDirectories,
    batch: &BatchAccess,
    stop: &CancellationToken,
) -> Result<(), StoreError> {
    let Some((job, attempt)) = job_and_attempt(directory) else { return Ok(()) };
    if is_being_removed(directory) {
        let left = directory.to_owned();
        blocking(move || local::remove(&left)).await;
        return Ok(());
    }
    let past = retry_until_written(stop, || store.past_calculation(job, attempt)).await?;
    // Otherwise it belongs to a copy of this campaign.
    let Some(past) = past.filter(|past| !past.wanted) else { return Ok(()) };
    let handle = past.calculation.as_deref().and_then(CalculationHandle::parse);
    let state = match handle.filter(|handle| handle.directory() == directory) {
        Some(handle) => Some(handle.inspect(batch).await?),
        None => None,
    };
    let is_removed = is_left_over(&past, state.as_ref());
    if is_removed && keep.keeps(past.failed) {
        pack(store, job, attempt, stop, directory).await?;
    }
    if is_removed {
        let cleared = directory.to_owned();
        blocking(move || local::clear(&cleared)).await.map_err(|error| file_error(directory, error))?;
    }
    Ok(())
}

/// Whether a labeller that starts may remove this directory: its result is not wanted, and as far as is known nothing runs there.
/// `state` is `None` if the store knows no calculation in this directory, usually because its creator was killed before anything started.
pub fn is_left_over(past: &PastCalculation, state: Option<&CalculationState>) -> bool {
    !past.wanted && state != Some(&CalculationState::Running)
}

/// Job and attempt in the name of a directory.
fn job_and_attempt(directory: &Path) -> Option<(i64, u32)> {
    let mut parts = directory.file_name()?.to_str()?.splitn(3, '-');
    Some((parts.next()?.parse().ok()?, parts.next()?.parse().ok()?))
}

fn is_old(directory: &Path) -> bool {
    let changed = fs::metadata(directory).and_then(|directory| directory.modified());
    changed.is_ok_and(|changed| changed.elapsed().is_ok_and(|age| age > MIN_AGE))
}
