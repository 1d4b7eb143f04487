//! The right to run a campaign: locks that another process may have for a while yet.

use std::path::Path;
use std::time::{Duration, Instant};

use store::{CampaignLock, Location, StoreError};

use crate::output::log_and_print;

/// Who takes the locks, as others are told.
const WHO: &str = "calmwalk run";
/// Between two tries to take a lock that another process has.
const NEXT_TRY: Duration = Duration::from_secs(1);

/// Takes the directory's lock. A campaign that is on a server may have its directory on a network file system, some of
/// which lock nothing: the server's lock is what counts there.
pub async fn directory(
    directory: &Path,
    location: &Location,
    patience: Duration,
) -> Result<Option<CampaignLock>, StoreError> {
    let acquire = async || CampaignLock::acquire(directory, WHO);
    match location {
        Location::Directory(_) => {
            store::check_directory(directory)?;
            patiently(patience, acquire).await.map(Some)
        }
        Location::Server(_) => match patiently(patience, acquire).await {
            Err(StoreError::File { .. }) => Ok(None),
            acquired => acquired.map(Some),
        },
    }
}

/// On a server the directory's lock is not enough: the campaign may be run from another host.
pub async fn server(location: &Location, patience: Duration) -> Result<Option<CampaignLock>, StoreError> {
    match location {
        Location::Server(_) => {
            patiently(patience, async || CampaignLock::acquire_at(location, WHO).await).await.map(Some)
        }
        Location::Directory(_) => Ok(None),
    }
}

/// Tries to take a lock until it is free, or for so long.
async fn patiently(
    patience: Duration,
    mut acquire: impl AsyncFnMut() -> Result<CampaignLock, StoreError>,
) -> Result<CampaignLock, StoreError> {
    let begun = Instant::now();
    let mut waiting = false;
    loop {
        match acquire().await {
            Err(error @ StoreError::Locked { .. }) if begun.elapsed() < patience => {
                if !std::mem::replace(&mut waiting, true) {
                    log_and_print(format_args!("waiting: {error}"));
                }
                tokio::time::sleep(NEXT_TRY).await;
            }
            acquired => return acquired,
        }
    }
}

/// Waits until another process has the lock.
pub async fn lost(lock: Option<&CampaignLock>) -> StoreError {
    match lock {
        Some(lock) => lock.lost().await,
        None => std::future::pending().await,
    }
}
