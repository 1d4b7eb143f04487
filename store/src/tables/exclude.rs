//! Excludes labels from the data set and includes them again.
//!
//! An excluded label has the status `excluded`, and no reader of labels sees it. Its job stays done, and further
//! results for the structure are checks; only a requested new label replaces it.

use std::collections::BTreeMap;

use serde_json::json;

use super::logs::insert_operation;
use super::structures;
use crate::Store;
use crate::database::{Transaction, from_columns, query};
use crate::error::{Result, StoreError};
use crate::exclude::{ExcludedLabel, Exclusion, ExclusionChange};

/// The structure of a candidate, if it was accepted.
const STRUCTURE_OF_CANDIDATE: &str = "SELECT coalesce(structure, 0) FROM candidate WHERE decision = $1";
const STRUCTURE_OF_IMPORT: &str = "SELECT structure FROM import WHERE number = $1";

/// Labels of a structure that count or are excluded.
pub(crate) const LABEL_STATUS: &str = "SELECT protocol.name AS protocol, status, exclusion FROM label
    CROSS JOIN protocol ON protocol.number = label.protocol
    WHERE label.structure = $1 AND status IN ('label', 'excluded')
    ORDER BY label.protocol, label.number";

const EXCLUDE: &str = "UPDATE label SET status = 'excluded', excluded = $2, exclusion = $3
    WHERE structure = $1 AND status = 'label'";

const INCLUDE: &str = "UPDATE label SET status = 'label', excluded = NULL, exclusion = NULL
    WHERE structure = $1 AND status = 'excluded'";

/// The newest job of a structure, and its state.
const JOB: &str = "SELECT number, state FROM job WHERE structure = $1 ORDER BY number DESC LIMIT 1";

const ALL: &str = "SELECT coalesce((SELECT id FROM candidate WHERE candidate.structure = label.structure
            ORDER BY decision LIMIT 1),
        (SELECT 'import-' || CAST(import.number AS TEXT) FROM import WHERE import.structure = label.structure), '') AS id,
        protocol.name AS protocol, excluded, exclusion
    FROM label CROSS JOIN protocol ON protocol.number = label.protocol
    WHERE status = 'excluded' ORDER BY excluded, label.number";

/// Why labels of jobs are excluded.
const EXCLUSIONS_BY_JOB: &str = "SELECT job.number, exclusion FROM label
    CROSS JOIN job ON job.structure = label.structure AND job.protocol = label.protocol WHERE status = 'excluded'";

const COUNT: &str = "SELECT count(*) FROM label WHERE status = 'excluded'";

struct LabelStatusRow {
    protocol: String,
    status: String,
    exclusion: Option<String>,
}

struct ExcludedRow {
    id: String,
    protocol: String,
    excluded: i64,
    exclusion: String,
}

from_columns!(LabelStatusRow { protocol, status, exclusion });
from_columns!(ExcludedRow { id, protocol, excluded, exclusion });

/// A structure named by the user.
pub(super) struct NamedStructure {
    pub structure: i64,
    pub id: String,
}

impl Store {
    /// Excludes the labels of structures from the data set, under every protocol: readers of labels do not see them
    /// until [`Store::include`]. Applies to all of the structures or to none; already excluded labels keep their
    /// reason. Structures are named as for [`Store::find_candidate`], or `import-N`. Adds a line `exclude` to the
    /// operations log for each.
    ///
    /// # Errors
    /// [`StoreError::NoLabel`] for a structure without a label, and errors for names that fit none or several.
    pub async fn exclude(&self, ids: &[String], reason: &str, now: i64) -> Result<Vec<ExclusionChange>> {
        self.change_status(ids, Some(reason), now).await
    }

    /// Includes excluded labels again. Adds a line `include` to the operations log for each structure.
    ///
    /// # Errors
    /// As [`Store::exclude`].
    pub async fn include(&self, ids: &[String], now: i64) -> Result<Vec<ExclusionChange>> {
        self.change_status(ids, None, now).await
    }

    /// What [`Self::exclude`] would change with this reason, or [`Self::include`] without one. Changes nothing.
    ///
    /// # Errors
    /// As for those.
    pub async fn exclusion_changes(
        &self,
        ids: &[String],
        reason: Option<&str>,
    ) -> Result<Vec<ExclusionChange>> {
        let named = self.named_structures(ids).await?;
        let mut transaction = self.database.begin_read().await?;
        let mut changes = Vec::new();
        for named in named {
            changes.push(planned(&mut transaction, &named, reason).await?);
        }
        Ok(changes)
    }

    /// Every excluded label, in order of exclusion.
    pub async fn excluded(&self) -> Result<Vec<ExcludedLabel>> {
        let mut transaction = self.database.begin_read().await?;
        if !has_exclusion_columns(&mut transaction).await? {
            return Ok(Vec::new());
        }
        let rows: Vec<ExcludedRow> = query(ALL).fetch_all(&mut transaction).await?;
        let excluded = rows.into_iter().map(|ExcludedRow { id, protocol, excluded, exclusion }| {
            ExcludedLabel { id, protocol, exclusion: Exclusion { time: excluded, reason: exclusion } }
        });
        Ok(excluded.collect())
    }

    async fn change_status(
        &self,
        ids: &[String],
        reason: Option<&str>,
        now: i64,
    ) -> Result<Vec<ExclusionChange>> {
        let named = self.named_structures(ids).await?;
        let mut transaction = self.database.begin().await?;
        let now = transaction.time(now).await?;
        structures::lock(&mut transaction, named.iter().map(|named| named.structure)).await?;
        let mut changes = Vec::new();
        for named in named {
            changes.push(change(&mut transaction, named, reason, now).await?);
        }
        transaction.commit().await?;
        Ok(changes)
    }

    /// The structures with these names, each once.
    pub(super) async fn named_structures(&self, ids: &[String]) -> Result<Vec<NamedStructure>> {
        let mut named: Vec<NamedStructure> = Vec::new();
        for id in ids {
            let found = self.named(id).await?;
            if named.iter().all(|other| other.structure != found.structure) {
                named.push(found);
            }
        }
        Ok(named)
    }

    /// The structure with that name.
    async fn named(&self, id: &str) -> Result<NamedStructure> {
        if let Some(number) = id.strip_prefix("import-") {
            let structure = match number.parse::<i64>() {
                Ok(number) => query(STRUCTURE_OF_IMPORT).bind(number).fetch_optional(&self.database).await?,
                Err(_) => None,
            };
            let imported = self.imported_structures().await?;
            let structure = structure.ok_or(StoreError::UnknownImport { id: id.to_owned(), imported })?;
            return Ok(NamedStructure { structure, id: id.to_owned() });
        }
        let found = self.find_candidate(id).await?;
        let structure: i64 =
            query(STRUCTURE_OF_CANDIDATE).bind(found.decision).fetch_one(&self.database).await?;
        if structure == 0 {
            return Err(StoreError::NoLabel { id: found.candidate, why: "it was declined".to_owned() });
        }
        Ok(NamedStructure { structure, id: found.candidate })
    }
}

/// What excluding the labels of a structure changes, or including them without a `reason`.
async fn planned(
    transaction: &mut Transaction,
    NamedStructure { structure, id }: &NamedStructure,
    reason: Option<&str>,
) -> Result<ExclusionChange> {
    let labels: Vec<LabelStatusRow> =
        query(LABEL_STATUS).bind(*structure).fetch_all(&mut *transaction).await?;
    if labels.is_empty() {
        return Err(no_label(id.clone(), newest_job(transaction, *structure).await?));
    }
    let changing = if reason.is_some() { "label" } else { "excluded" };
    let changed = labels.iter().any(|label| label.status == changing);
    let mut protocols: Vec<_> = labels.iter().map(|label| label.protocol.clone()).collect();
    protocols.dedup();
    let before =
        labels.into_iter().find(|label| label.status == "excluded").and_then(|label| label.exclusion);
    let excluded = reason.map(|reason| before.filter(|_| !changed).unwrap_or(reason.to_owned()));
    Ok(ExclusionChange { id: id.clone(), protocols, changed, excluded })
}

/// Excludes the labels of a structure, or includes them without a `reason`.
async fn change(
    transaction: &mut Transaction,
    named: NamedStructure,
    reason: Option<&str>,
    now: i64,
) -> Result<ExclusionChange> {
    let change = planned(transaction, &named, reason).await?;
    if change.changed {
        let update = match reason {
            Some(reason) => query(EXCLUDE).bind(named.structure).bind(now).bind(reason),
            None => query(INCLUDE).bind(named.structure),
        };
        update.execute(&mut *transaction).await?;
        let job = newest_job(transaction, named.structure).await?.map(|(number, _)| number);
        let kind = if reason.is_some() { "exclude" } else { "include" };
        let detail =
            json!({ "candidate": change.id, "job": job, "reason": reason, "protocols": change.protocols });
        insert_operation(transaction, now, kind, &detail).await?;
    }
    Ok(change)
}

async fn newest_job(transaction: &mut Transaction, structure: i64) -> Result<Option<(i64, String)>> {
    query(JOB).bind(structure).fetch_optional(&mut *transaction).await
}

fn no_label(id: String, job: Option<(i64, String)>) -> StoreError {
    let why = job.map_or("it has no label job".to_owned(), |(_, state)| format!("its label job is {state}"));
    StoreError::NoLabel { id, why }
}

/// Checks that a structure has a label that counts.
///
/// # Errors
/// [`StoreError::NoLabel`].
pub(super) async fn check_has_label(transaction: &mut Transaction, structure: i64, id: &str) -> Result<()> {
    let labels: Vec<LabelStatusRow> =
        query(LABEL_STATUS).bind(structure).fetch_all(&mut *transaction).await?;
    if labels.is_empty() {
        return Err(no_label(id.to_owned(), newest_job(transaction, structure).await?));
    }
    match labels.iter().any(|label| label.status == "label") {
        true => Ok(()),
        false => Err(StoreError::NoLabel { id: id.to_owned(), why: "its label is excluded".to_owned() }),
    }
}

/// Whether the tables have the columns for exclusions; those of an earlier version do not.
pub(super) async fn has_exclusion_columns(transaction: &mut Transaction) -> Result<bool> {
    transaction.has_column("label", "exclusion").await
}

/// Number of excluded labels.
pub(super) async fn count(transaction: &mut Transaction) -> Result<u64> {
    match has_exclusion_columns(transaction).await? {
        true => query(COUNT).fetch_one(transaction).await,
        false => Ok(0),
    }
}

/// Reasons of exclusions, by job id.
pub(super) async fn by_job(transaction: &mut Transaction) -> Result<BTreeMap<i64, String>> {
    if !has_exclusion_columns(transaction).await? {
        return Ok(BTreeMap::new());
    }
    let rows: Vec<(i64, String)> = query(EXCLUSIONS_BY_JOB).fetch_all(transaction).await?;
    Ok(rows.into_iter().collect())
}
