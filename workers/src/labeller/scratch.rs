//! Where calculations have their directories, and what becomes of those.
//!
//! | | |
//! | --- | --- |
//! | `<scratch>/calmwalk-<campaign>-<random>/` | a campaign's, of this user alone: see [`private`]; whoever comes later finds it by its name and owner |
//! | `<scratch>/calmwalk-<campaign>-<random>/<job>-<attempt>-<time>/` | a calculation's, with the folders `work` and `data` |

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use store::{Store, StoreError};
use wire::CampaignId;

use super::begun::{Begun, Found};
use super::code::{blocking, file};
use super::running::Keep;
use super::slurm::{self, Slurm};
use super::{Closing, here, insist, pack, private};

/// What was left behind is only cleared away when nobody can still be at it.
const AGE: Duration = Duration::from_secs(60);
/// How often it is tried to make a directory where somebody else clears away empty ones.
const TRIES: u32 = 100;

/// Where all calculations of a campaign that this user makes with this scratch directory are.
#[derive(Debug)]
pub(super) struct Home {
    scratch: PathBuf,
    /// What the names of its directories begin with. Several labellers that begin at once may make one each.
    prefix: String,
}

impl Home {
    /// That of a campaign.
    pub fn of(scratch: &Path, campaign: CampaignId) -> Self {
        Self { scratch: scratch.to_owned(), prefix: format!("calmwalk-{campaign}") }
    }

    /// Makes a directory for calculations, if there is none.
    ///
    /// # Errors
    /// None can be made in which nobody else could change anything.
    pub fn prepare(&self) -> Result<PathBuf, StoreError> {
        private::check(&self.scratch)?;
        let prefix = format!("{}-", self.prefix);
        let found = private::ours_in(&self.scratch, &prefix).map_err(|error| file(&self.scratch, error))?;
        match found.into_iter().find(|path| private::is_closed(path)) {
            Some(home) => Ok(home),
            None => private::make(&self.scratch, &prefix),
        }
    }

    /// Makes the directory of a calculation.
    ///
    /// # Errors
    /// The same.
    pub fn make(&self, job: i64, attempt: u32) -> Result<PathBuf, StoreError> {
        let mut tries = 0;
        loop {
            let home = self.prepare()?;
            tries += 1;
            match private::make_inside(&home, &name(job, attempt)) {
                // Whoever ended last has cleared it away.
                Err(error) if error.kind() == io::ErrorKind::NotFound && tries < TRIES => {}
                made => return made.map_err(|error| file(&home, error)),
            }
        }
    }

    /// Clears away the directories that killed labellers have left, as far as nobody needs them: those of calculations whose
    /// keeper is gone and whose job waits for nothing.
    pub async fn tidy(
        &self,
        store: &Store,
        keep: Keep,
        slurm: &Slurm,
        closing: &Closing,
    ) -> Result<(), StoreError> {
        for home in self.all()? {
            let entries = fs::read_dir(&home).map_err(|error| file(&home, error))?;
            for directory in entries.flatten().map(|entry| entry.path()).filter(|path| is_old(path)) {
                tidy_one(store, &directory, keep, slurm, closing).await?;
            }
        }
        Ok(())
    }

    /// Removes directories in which no calculation is.
    pub fn remove_empty(&self) {
        for home in self.all().unwrap_or_default() {
            remove_empty(&home);
        }
    }

    /// All directories of this campaign, also those that an earlier version of this program has made.
    fn all(&self) -> Result<Vec<PathBuf>, StoreError> {
        private::ours_in(&self.scratch, &self.prefix).map_err(|error| file(&self.scratch, error))
    }
}

/// Removes the directory that holds those of calculations if there are none.
pub(super) fn remove_empty(home: &Path) {
    let is_calculation = |path: &Path| numbers(path).is_some();
    let entries = fs::read_dir(home).into_iter().flatten().flatten();
    if !entries.map(|entry| entry.path()).any(|path| is_calculation(&path)) {
        slurm::forget(home);
        // Another labeller may be making one there.
        let _ = fs::remove_dir(home);
    }
}

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

async fn tidy_one(
    store: &Store,
    directory: &Path,
    keep: Keep,
    slurm: &Slurm,
    closing: &Closing,
) -> Result<(), StoreError> {
    let Some((job, attempt)) = numbers(directory) else { return Ok(()) };
    let past = insist(closing, || store.past_calculation(job, attempt)).await?;
    // Of a copy of this campaign.
    let Some(past) = past.filter(|past| !past.wanted) else { return Ok(()) };
    let begun = past.calculation.as_deref().and_then(Begun::parse);
    let is_over = match begun.filter(|begun| begun.directory() == directory) {
        Some(begun) => !matches!(begun.look(slurm).await?, Found::Running),
        // Whoever made it was killed before anything began.
        None => true,
    };
    if is_over && keep.keeps(past.failed) {
        pack(store, job, attempt, closing, directory).await?;
    }
    if is_over {
        let cleared = directory.to_owned();
        blocking(move || here::clear(&cleared)).await.map_err(|error| file(directory, error))?;
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
