//! Where the campaign is kept: a directory on this host, or a server.

use std::path::Path;

use store::{Location, Store, StoreError};

use super::check::MachineCheck;
use super::machine::nearest_existing;
use crate::cli::{CommandError, block_on};
use crate::disk_forecast::WAL_BYTES;
use crate::wording::disk::megabytes;

/// The file system of a directory that may not exist yet; `needed` are the bytes that the campaign will take.
pub fn checks(directory: &Path, needed: Option<u64>) -> Vec<MachineCheck> {
    let place = nearest_existing(directory);
    vec![file_system(place), locks(place), free_space(place, needed)]
}

fn file_system(place: &Path) -> MachineCheck {
    const NAME: &str = "file system";
    const NEEDED_FOR: &str = "the database of a campaign, which must be on a local disk";
    let found = place.canonicalize().unwrap_or_else(|_| place.to_owned()).display().to_string();
    let check = match store::check_directory(place) {
        Ok(()) => MachineCheck::present(NAME, format!("{found}: local, writable"), NEEDED_FOR),
        Err(StoreError::NetworkFileSystem { kind, .. }) => {
            let advice =
                "keep the campaign on a local disk (run --directory DIR), or in PostgreSQL (run.store)";
            MachineCheck::absent(NAME, format!("{found}: {kind}, a network file system"), NEEDED_FOR, advice)
        }
        Err(error) => {
            let advice = "give this user the right to write there, or another directory (--directory DIR)";
            MachineCheck::absent(NAME, error.to_string(), NEEDED_FOR, advice)
        }
    };
    check.required_if(true)
}

fn locks(place: &Path) -> MachineCheck {
    const NAME: &str = "file locks";
    const NEEDED_FOR: &str = "one run for each campaign, the database";
    let locked = tempfile::tempfile_in(place).and_then(|file| file.try_lock().map_err(std::io::Error::from));
    let check = match locked {
        Ok(()) => MachineCheck::present(NAME, "work", NEEDED_FOR),
        Err(error) => {
            let advice = "use a file system with locks (--directory DIR), or mount this one with them";
            MachineCheck::absent(NAME, format!("do not work: {error}"), NEEDED_FOR, advice)
        }
    };
    check.required_if(true)
}

fn free_space(place: &Path, needed: Option<u64>) -> MachineCheck {
    const NAME: &str = "free disk space";
    const NEEDED_FOR: &str = "structures, features, labels and checkpoints of a campaign";
    let wanted = needed.unwrap_or(WAL_BYTES);
    let check = match store::free_space(place) {
        Ok(free) if free >= wanted => MachineCheck::present(NAME, megabytes(free), NEEDED_FOR),
        Ok(free) => {
            let advice = format!(
                "{} are needed: free some, use another directory (--directory DIR), or lower collect.declined_features_mb",
                megabytes(wanted)
            );
            MachineCheck::absent(NAME, megabytes(free), NEEDED_FOR, advice)
        }
        Err(error) => MachineCheck::absent(
            NAME,
            error.to_string(),
            NEEDED_FOR,
            "use another directory (--directory DIR)",
        ),
    };
    check.required_if(true)
}

/// Whether the server of a campaign answers.
pub fn server(url: &str) -> Result<MachineCheck, CommandError> {
    const NAME: &str = "database server";
    const NEEDED_FOR: &str = "the store of the campaign (run.store)";
    let location: Location = url.parse()?;
    let opened = block_on(async {
        let store = Store::open_read_only(&location).await?;
        store.close().await;
        Ok::<_, StoreError>(())
    })?;
    let check = match opened {
        Ok(()) => MachineCheck::present(NAME, format!("{location}: has a campaign"), NEEDED_FOR),
        // The first run makes the tables.
        Err(StoreError::Missing { .. }) => {
            MachineCheck::present(NAME, format!("{location}: answers"), NEEDED_FOR)
        }
        Err(error) => MachineCheck::absent(
            NAME,
            error.to_string(),
            NEEDED_FOR,
            "start the server, or correct run.store",
        ),
    };
    Ok(check.required_if(true))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_directory_of_this_machine_is_good_enough_and_full_disks_are_told() {
        let here = tempfile::tempdir().unwrap();
        let found = checks(&here.path().join("new/campaign"), None);
        assert!(found.iter().all(|check| !check.is_missing()), "{found:?}");
        let full = checks(here.path(), Some(u64::MAX));
        let missing: Vec<_> =
            full.iter().filter(|check| check.is_missing()).map(MachineCheck::name).collect();
        assert_eq!(missing, ["free disk space"]);
    }
}
