//! Checks versions of the potential. Reads their files one at a time and writes nothing.

use std::collections::BTreeSet;

use serde_json::Value;

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

/// The decisions that switch to versions, in order.
const TAKEN_UP: &str = "SELECT sequence, detail FROM decision WHERE kind = 'version' ORDER BY sequence";
const CONDITIONS: &str = "SELECT walk, conditions FROM walk_conditions ORDER BY walk";

/// Checks the invariants between versions, their files, the decision log and the walks. Tables of an earlier version have none.
pub(super) async fn rules(transaction: &mut Transaction) -> Result<Vec<Finding>> {
    let mut findings = Vec::new();
    if transaction.has_table("version_file").await? {
        for rule in &RULES {
            findings.extend(rule.find(transaction).await?);
        }
        let taken_up = taken_up(transaction, &mut findings).await?;
        findings.extend(walks(transaction, &taken_up).await?);
    }
    Ok(findings)
}

/// The versions that the log switches to. Adds a finding for each that is not registered with these
/// files, or not newer than the one before.
async fn taken_up(transaction: &mut Transaction, findings: &mut Vec<Finding>) -> Result<BTreeSet<u64>> {
    const HASHES: &str =
        "SELECT model_hash, mixture_hash FROM version WHERE number = $1 AND state = 'registered'";
    let decisions: Vec<(i64, String)> = query(TAKEN_UP).fetch_all(&mut *transaction).await?;
    let (mut taken_up, mut last) = (BTreeSet::new(), 0);
    for (sequence, detail) in decisions {
        // Text that is no JSON is a fault of its own.
        let Ok(detail) = serde_json::from_str::<Value>(&detail) else { continue };
        let number = detail["version"].as_u64().unwrap_or(0);
        let known = query(HASHES).bind(i64::try_from(number).unwrap_or(i64::MAX));
        let known: Option<(String, String)> = known.fetch_optional(&mut *transaction).await?;
        let same = |(model, mixture): &(String, String)| {
            detail["model"] == model.as_str() && detail["mixture"] == mixture.as_str()
        };
        let problem = match known {
            None => Some("is not registered"),
            Some(known) if !same(&known) => Some("has other files than the decision names"),
            Some(_) if number <= last => Some("is not newer than the one before"),
            Some(_) => None,
        };
        if let Some(problem) = problem {
            let what =
                format!("decision {sequence} switches to version {number} of the potential, which {problem}");
            findings.push(Finding { what, then: LOST });
        }
        last = last.max(number);
        taken_up.insert(number);
    }
    Ok(taken_up)
}

/// Checks that walks run with versions that the log has switched to.
async fn walks(transaction: &mut Transaction, taken_up: &BTreeSet<u64>) -> Result<Option<Finding>> {
    if !transaction.has_table("walk_conditions").await? {
        return Ok(None);
    }
    let conditions: Vec<(u32, String)> = query(CONDITIONS).fetch_all(transaction).await?;
    let version = |text: &str| {
        let conditions: Option<Value> = serde_json::from_str(text).ok();
        conditions.and_then(|conditions| conditions["version"].as_u64()).unwrap_or(0)
    };
    let is_wrong = |(_, text): &&(u32, String)| {
        let version = version(text);
        version > 0 && !taken_up.contains(&version)
    };
    let wrong: Vec<_> = conditions.iter().filter(is_wrong).collect();
    Ok(wrong.first().map(|(walk, _)| Finding {
        what: format!(
            "{} walks with versions of the potential that no decision switches to (such as {walk})",
            wrong.len()
        ),
        then: LOST,
    }))
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
