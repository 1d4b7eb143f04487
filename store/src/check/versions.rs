//! Checks versions of the potential. Reads their files one at a time and writes nothing.

use super::finding::Finding;
use super::rules::{ConsistencyRule, LOST};
use crate::database::{FromRow, Transaction, query};
use crate::error::{Result, StoreError};
use crate::tables::versions::{all_versions, read_file};
use crate::versions::{VersionRecord, VersionState};

const RULES: [ConsistencyRule; 3] = [
    ConsistencyRule {
        finds: "SELECT count(*), CAST(min(number) AS TEXT) FROM version WHERE number < 1 OR number > 1
                AND NOT EXISTS (SELECT 1 FROM version AS before WHERE before.number = version.number - 1)",
        what: "versions of the potential with a number below 1 or after a gap",
        then: LOST,
    },
    ConsistencyRule {
        finds: "SELECT count(*), CAST(min(number) AS TEXT) FROM version WHERE parent <> 0
                AND NOT EXISTS (SELECT 1 FROM version AS earlier WHERE earlier.number = version.parent
                                AND earlier.number < version.number AND earlier.state = 'registered')",
        what: "versions of the potential without a registered parent",
        then: LOST,
    },
    ConsistencyRule {
        finds: "SELECT count(*), CAST(min(version_file.version) AS TEXT) FROM version_file
                WHERE NOT EXISTS (SELECT 1 FROM version AS owner WHERE owner.number = version_file.version
                                  AND owner.state = 'registered')",
        what: "files of versions of the potential that are not registered",
        then: LOST,
    },
];

/// Checks the invariants between versions and their files. Tables of an earlier version have none.
pub(super) async fn rules(transaction: &mut Transaction) -> Result<Vec<Finding>> {
    let mut findings = Vec::new();
    if transaction.has_table("version_file").await? {
        for rule in &RULES {
            findings.extend(rule.find(transaction).await?);
        }
    }
    Ok(findings)
}

/// Number of files of versions.
pub(super) async fn count_files(transaction: &mut Transaction) -> Result<u64> {
    if !transaction.has_table("version_file").await? {
        return Ok(0);
    }
    query("SELECT count(*) FROM version_file").fetch_one(transaction).await
}

/// The registered versions whose rows are intact. Adds the faults of all others.
pub(super) async fn registered(
    transaction: &mut Transaction,
    faults: &mut Vec<String>,
) -> Result<Vec<VersionRecord>> {
    let mut registered = Vec::new();
    for row in &all_versions(transaction).await? {
        match VersionRecord::from_row(row) {
            Ok(record) if record.state == VersionState::Registered => registered.push(record),
            Ok(_) => {}
            Err(error) => faults.push(damage(error)?),
        }
    }
    Ok(registered)
}

/// The fault of a file of a version, by its name and hash.
pub(super) async fn file_fault(
    transaction: &mut Transaction,
    number: u32,
    (name, hash): (&'static str, &str),
) -> Result<Option<String>> {
    match read_file(transaction, number, name, hash).await {
        Ok(_) => Ok(None),
        Err(error) => damage(error).map(Some),
    }
}

/// The description of damage; any other error as it is.
fn damage(error: StoreError) -> Result<String> {
    match error {
        StoreError::Damaged { what, reason } => Ok(format!("{what}: {reason}")),
        error => Err(error),
    }
}
