//! The locks of a campaign, which ensure that one process runs it. Waits while another process holds them.

use std::path::Path;
use std::time::{Duration, Instant};

use store::{CampaignLock, Location, StoreError};

use crate::output::log_and_print;

/// The name of the lock holder in messages of other processes.
const HOLDER: &str = "calmwalk run";
/// Between two attempts to acquire a lock.
const RETRY_INTERVAL: Duration = Duration::from_secs(1);

/// Acquires the lock of the directory. With the store on a server, the directory may be on a network file system without locks;
/// the lock of the server decides there.
pub async fn directory(
    directory: &Path,
    location: &Location,
    timeout: Duration,
) -> Result<Option<CampaignLock>, StoreError> {
    let acquire = async || CampaignLock::acquire(directory, HOLDER);
    match location {
        Location::Directory(_) => {
            store::check_directory(directory)?;
            retry_until(timeout, acquire).await.map(Some)
        }
        Location::Server(_) => match retry_until(timeout, acquire).await {
            Err(StoreError::File { .. }) => Ok(None),
            acquired => acquired.map(Some),
        },
    }
}

/// Acquires the lock on the server: the lock of the directory does not exclude runs on other hosts.
pub async fn server(location: &Location, timeout: Duration) -> Result<Option<CampaignLock>, StoreError> {
    match location {
        Location::Server(_) => {
            retry_until(timeout, async || CampaignLock::acquire_at(location, HOLDER).await).await.map(Some)
        }
        Location::Directory(_) => Ok(None),
    }
}

/// Tries to acquire a lock until it is free, for at most `timeout`.
async fn retry_until(
    timeout: Duration,
    mut acquire: impl AsyncFnMut() -> Result<CampaignLock, StoreError>,
) -> Result<CampaignLock, StoreError> {
    let started = Instant::now();
    let mut waiting = false;
    loop {
        match acquire().await {
            Err(error @ StoreError::Locked { .. }) if started.elapsed() < timeout => {
                if !std::mem::replace(&mut waiting, true) {
                    log_and_print(format_args!("waiting: {error}"));
                }
                tokio::time::sleep(RETRY_INTERVAL).await;
            }
            acquired => return acquired,
        }
    }
}

/// Returns when the lock is lost to another process.
pub async fn lost(lock: Option<&CampaignLock>) -> StoreError {
    match lock {
        Some(lock) => lock.lost().await,
        None => std::future::pending().await,
    }
}
