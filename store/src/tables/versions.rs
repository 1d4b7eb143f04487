//! Versions of the potential and their files.

use crate::Store;
use crate::checksum::{Names, VERSION};
use crate::database::{FromRow, SqlRow, SqlValue, Transaction, query};
use crate::encoding::integer;
use crate::error::{Result, StoreError};
use crate::versions::{VersionFiles, VersionRecord, VersionState};

const TABLE: &str = "version";
/// Names of the files in `version_file`.
const MODEL: &str = "model";
const MIXTURE: &str = "mixture";

/// Waits for another process that adds the same number, and adds nothing once that is committed.
const INSERT: &str = "INSERT INTO version (number, parent, state, reason, method, structures, last_decision, labels,
        model_hash, mixture_hash, figures, seconds, core_hours, time, checksum)
    VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13, $14, $15) ON CONFLICT (number) DO NOTHING";
const INSERT_FILE: &str = "INSERT INTO version_file (version, name, data) VALUES ($1, $2, $3)";
pub(crate) const NEXT: &str = "SELECT coalesce(max(number), 0) + 1 FROM version";
const IS_REGISTERED: &str =
    "SELECT EXISTS (SELECT 1 FROM version WHERE number = $1 AND state = 'registered')";
const ONE: &str = "SELECT * FROM version WHERE number = $1";
pub(crate) const FILE: &str = "SELECT data FROM version_file WHERE version = $1 AND name = $2";

impl Store {
    /// Registers a version with its files, or records a refused attempt, which has none. In one transaction, which any
    /// process may make. If its answer is lost, [`Self::versions`] tells whether it was made.
    ///
    /// # Errors
    /// [`StoreError::VersionNumber`] unless the number is one more than the largest: another process may have added a
    /// version meanwhile. [`StoreError::Inconsistent`] for a registered version without files, a refused one with
    /// files, hashes that are not those of the files, a parent that is not registered, or numbers that are not finite.
    pub async fn add_version(&self, record: &VersionRecord, files: Option<&VersionFiles>) -> Result<()> {
        check_consistency(record, files)?;
        let row = VERSION.with_checksum(values(record)?);
        let number = record.number;
        let mut transaction = self.database.begin().await?;
        let next: u32 = query(NEXT).fetch_one(&mut transaction).await?;
        if number != next {
            return Err(StoreError::VersionNumber { number, next });
        }
        check_parent(&mut transaction, record).await?;
        if query(INSERT).bind_all(row).execute(&mut transaction).await? == 0 {
            return Err(StoreError::VersionNumber { number, next: next.saturating_add(1) });
        }
        if let Some(VersionFiles { model, mixture }) = files {
            for (name, data) in [(MODEL, model), (MIXTURE, mixture)] {
                let insert = query(INSERT_FILE).bind(number).bind(name).bind(data.as_slice());
                insert.execute(&mut transaction).await?;
            }
        }
        transaction.commit().await
    }

    /// All versions and refused attempts, by number. A database of an earlier version has none.
    pub async fn versions(&self) -> Result<Vec<VersionRecord>> {
        let mut transaction = self.database.begin_read().await?;
        let rows = all_versions(&mut transaction).await?;
        transaction.commit().await?;
        rows.iter().map(VersionRecord::from_row).collect()
    }

    /// The files of a registered version, verified against its hashes; `None` if no version with this number is
    /// registered.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] names the version and the file if it is missing or has another hash.
    pub async fn version_files(&self, number: u32) -> Result<Option<VersionFiles>> {
        let mut transaction = self.database.begin_read().await?;
        let files = match find(&mut transaction, number).await? {
            Some(record) if record.state == VersionState::Registered => {
                let [(model, model_hash), (mixture, mixture_hash)] = expected_files(&record);
                Some(VersionFiles {
                    model: read_file(&mut transaction, number, model, model_hash).await?,
                    mixture: read_file(&mut transaction, number, mixture, mixture_hash).await?,
                })
            }
            _ => None,
        };
        transaction.commit().await?;
        Ok(files)
    }
}

/// Checks what can be checked without the database.
fn check_consistency(record: &VersionRecord, files: Option<&VersionFiles>) -> Result<()> {
    let number = record.number;
    let wrong = |reason: String| Err(StoreError::Inconsistent(format!("version {number} {reason}")));
    if !record.seconds.is_finite() || !record.core_hours.is_finite() {
        return wrong(format!("took {} s and {} core hours", record.seconds, record.core_hours));
    }
    match (record.state, files) {
        (VersionState::Registered, None) => wrong("is registered without files".into()),
        (VersionState::Refused, Some(_)) => wrong("is refused and has files".into()),
        (VersionState::Refused, None) => {
            let hash = [&record.model_hash, &record.mixture_hash].into_iter().find(|hash| !hash.is_empty());
            hash.map_or(Ok(()), |hash| wrong(format!("is refused and has a file with the hash {hash}")))
        }
        (VersionState::Registered, Some(files)) => {
            for ((name, expected), found) in expected_files(record).into_iter().zip(files.hashes()) {
                if found != expected {
                    return wrong(format!(
                        "has a {name} with the BLAKE3 hash {found}, and its record says '{expected}'"
                    ));
                }
            }
            Ok(())
        }
    }
}

async fn check_parent(transaction: &mut Transaction, record: &VersionRecord) -> Result<()> {
    let VersionRecord { number, parent, .. } = *record;
    if parent == 0 || query(IS_REGISTERED).bind(parent).fetch_one(transaction).await? {
        return Ok(());
    }
    let reason = format!("version {number} has the parent {parent}, which is not a registered version");
    Err(StoreError::Inconsistent(reason))
}

/// The columns of a version, in the order of the table.
fn values(record: &VersionRecord) -> Result<Vec<SqlValue>> {
    Ok(vec![
        record.number.into(),
        record.parent.into(),
        record.state.name().into(),
        (&record.reason).into(),
        (&record.method).into(),
        integer("number of structures", record.structures)?.into(),
        record.last_decision.into(),
        integer("number of labels", record.labels)?.into(),
        (&record.model_hash).into(),
        (&record.mixture_hash).into(),
        record.figures.to_string().into(),
        record.seconds.into(),
        record.core_hours.into(),
        record.time.into(),
    ])
}

/// The rows of all versions by number, not verified yet. Databases of earlier versions lack the table.
pub(crate) async fn all_versions(transaction: &mut Transaction) -> Result<Vec<SqlRow>> {
    if !transaction.has_table(TABLE).await? {
        return Ok(Vec::new());
    }
    query("SELECT * FROM version ORDER BY number").rows(transaction).await
}

async fn find(transaction: &mut Transaction, number: u32) -> Result<Option<VersionRecord>> {
    if !transaction.has_table(TABLE).await? {
        return Ok(None);
    }
    query(ONE).bind(number).fetch_optional(transaction).await
}

/// Name and hash of each file of a registered version: model and mixture.
pub(crate) fn expected_files(record: &VersionRecord) -> [(&'static str, &str); 2] {
    [(MODEL, record.model_hash.as_str()), (MIXTURE, record.mixture_hash.as_str())]
}

/// Reads a file of a version and verifies its hash.
///
/// # Errors
/// [`StoreError::Damaged`] if it is missing or has another hash.
pub(crate) async fn read_file(
    transaction: &mut Transaction,
    number: u32,
    name: &'static str,
    expected: &str,
) -> Result<Vec<u8>> {
    let damaged = |reason: String| StoreError::damaged(format!("the {name} of version {number}"), reason);
    let data: Option<Vec<u8>> = query(FILE).bind(number).bind(name).fetch_optional(transaction).await?;
    let data = data.ok_or_else(|| damaged("it is missing".into()))?;
    let found = blake3::hash(&data).to_hex();
    if found.as_str() != expected {
        return Err(damaged(format!("its BLAKE3 hash is {found}, and '{expected}' was stored with it")));
    }
    Ok(data)
}

impl FromRow for VersionRecord {
    fn from_row(row: &SqlRow) -> Result<Self> {
        VERSION.verify(row, Names::Plain)?;
        let number: u32 = row.get("number")?;
        let damaged = |reason: String| StoreError::damaged(format!("version {number}"), reason);
        let (state, figures): (String, String) = (row.get("state")?, row.get("figures")?);
        Ok(Self {
            number,
            parent: row.get("parent")?,
            state: VersionState::named(&state).ok_or_else(|| damaged(format!("its state is '{state}'")))?,
            reason: row.get("reason")?,
            method: row.get("method")?,
            structures: row.get("structures")?,
            last_decision: row.get("last_decision")?,
            labels: row.get("labels")?,
            model_hash: row.get("model_hash")?,
            mixture_hash: row.get("mixture_hash")?,
            figures: serde_json::from_str(&figures)
                .map_err(|error| damaged(format!("its figures are not valid JSON ({error})")))?,
            seconds: row.get("seconds")?,
            core_hours: row.get("core_hours")?,
            time: row.get("time")?,
        })
    }
}
