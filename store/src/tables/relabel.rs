//! Making labels again: under the same protocol because they are doubtful, or under another protocol that comes
//! into force.
//!
//! A job with a reason in `relabel` waits for a new label although there is one. Readers of labels see no change
//! until the new label arrives, and none at all if it never does. A job of an earlier protocol is superseded when
//! the newer protocol has a label for the structure, or at once if it has no label itself.

use std::collections::HashSet;

use serde_json::json;
use wire::ContentHash;

use super::logs::insert_operation;
use super::protocols::{in_force, insert_protocol, protocol_id, set_campaign_value};
use super::structures::has_label;
use crate::Store;
use crate::database::{FromRow, SqlRow, SqlValue, Transaction, execute_rows, from_columns, query};
use crate::encoding::decode_hash;
use crate::error::{Result, StoreError};
use crate::jobs::{LabelSource, LabelStatus};
use crate::records::JobState;
use crate::relabel::{NewProtocol, RelabelCounts, RelabelRequest, Relabellable};

/// Jobs with their labels. A structure with labels under several protocols has several rows.
pub(crate) const LABELLED: &str =
    "SELECT structure.hash AS hash, job.decision AS decision, protocol.name AS protocol, own.state AS state,
        coalesce(candidate.seed_structure, 4294967295) AS seed_structure, structure.formula AS formula,
        structure.atoms AS atoms
    FROM job
    CROSS JOIN label ON label.structure = job.structure AND label.protocol = job.protocol AND status IN ('label', 'excluded')
    CROSS JOIN structure ON structure.number = job.structure
    CROSS JOIN protocol ON protocol.number = job.protocol
    LEFT JOIN candidate ON candidate.decision = job.decision
    LEFT JOIN job AS own ON own.structure = job.structure AND own.protocol = $1
    WHERE job.state <> 'dropped' ORDER BY job.decision, job.number";

/// Adds a job for structures that have none under that protocol. `own` is the job that made the present label.
macro_rules! request {
    ($states:literal) => {
        concat!(
            "INSERT INTO job (structure, protocol, decision, priority, state, overruled, relabel, relabel_after)
            SELECT own.structure, new.protocol, own.decision, own.priority, 'queued', 1, new.reason, 0
            FROM {rows} CROSS JOIN structure ON structure.hash = new.hash
            CROSS JOIN job AS own ON own.structure = structure.number AND own.number = (
                SELECT max(job.number) FROM job CROSS JOIN label ON label.structure = job.structure
                AND label.protocol = job.protocol AND status IN ('label', 'excluded')
                WHERE job.structure = structure.number AND job.state <> 'dropped')
            WHERE TRUE
            ON CONFLICT (structure, protocol) DO UPDATE SET state = 'queued', failures = 0, overruled = 1,
                relabel = excluded.relabel, relabel_after = job.attempts, value = NULL, value_factors = NULL
                WHERE job.state IN (",
            $states,
            ")"
        )
    };
}
const REQUEST: &str = request!("'failed', 'superseded'");
const REQUEST_INCLUDING_CURRENT: &str = request!("'labelled', 'failed', 'superseded'");

/// Withdraws requests under protocols no longer in force: the existing labels stay.
const WITHDRAW_REQUESTS: &str =
    "UPDATE job SET state = 'labelled', relabel = NULL, relabel_after = NULL, holder = NULL,
        expires = NULL
    WHERE protocol <> $1 AND state IN ('queued', 'leased') AND EXISTS (SELECT 1 FROM label
        WHERE label.structure = job.structure AND label.protocol = job.protocol AND status IN ('label', 'excluded'))";

/// Moves jobs of earlier protocols without a label to the protocol in force, unless that has a job for the
/// structure in another state.
const MOVE_JOBS: &str = "INSERT INTO job (structure, protocol, decision, priority, state, overruled, relabel, relabel_after)
    SELECT structure, CAST($1 AS BIGINT), decision, priority, CASE WHEN EXISTS (SELECT 1 FROM label
            WHERE label.structure = job.structure AND label.protocol = $1 AND status IN ('label', 'excluded'))
            THEN 'labelled' ELSE 'queued' END, overruled, relabel, 0
        FROM job WHERE protocol <> $1 AND state IN ('queued', 'leased', 'failed')
    ON CONFLICT (structure, protocol) DO UPDATE SET state = 'queued', failures = 0, overruled = excluded.overruled,
        relabel = excluded.relabel, relabel_after = job.attempts, value = NULL, value_factors = NULL
        WHERE job.state = 'superseded'";

const SUPERSEDE_UNLABELLED: &str =
    "UPDATE job SET state = 'superseded', relabel = NULL, relabel_after = NULL, holder = NULL,
        expires = NULL
    WHERE protocol <> $1 AND state IN ('queued', 'leased', 'failed')";

/// Ends attempts at jobs that are no longer leased.
const END_ATTEMPTS: &str = "UPDATE attempt SET ended = $1, outcome = 'dropped' WHERE outcome IS NULL
    AND EXISTS (SELECT 1 FROM job WHERE job.number = attempt.job AND state <> 'leased')";

/// Labels that belong to a job of the structure. Others belong to other data sets.
const SUPERSEDE: &str = "UPDATE label SET status = 'superseded', superseded = $2, reason = $3
    WHERE structure = $1 AND status IN ('label', 'excluded') AND EXISTS (SELECT 1 FROM job
        WHERE job.structure = label.structure AND job.protocol = label.protocol)";

const SUPERSEDE_JOBS: &str =
    "UPDATE job SET state = 'superseded', relabel = NULL, relabel_after = NULL, holder = NULL,
        expires = NULL
    WHERE structure = $1 AND protocol <> $2 AND state NOT IN ('dropped', 'superseded')";

/// Number of jobs with a request for a new label, by state.
const REQUESTED: &str = "SELECT state, count(*) FROM job WHERE relabel IS NOT NULL GROUP BY state";

/// The columns of a job that decide the status of a result.
struct RelabelRow {
    number: i64,
    state: String,
    relabel: Option<String>,
    relabel_after: Option<u32>,
}

from_columns!(RelabelRow { number, state, relabel, relabel_after });

impl FromRow for Relabellable {
    fn from_row(row: &SqlRow) -> Result<Self> {
        let (hash, state): (Vec<u8>, Option<String>) = (row.get("hash")?, row.get("state")?);
        let named = |state: String| {
            JobState::named(&state).ok_or_else(|| StoreError::damaged("the state of a job", state))
        };
        Ok(Self {
            content: decode_hash(&hash)?,
            decision: row.get("decision")?,
            protocol: row.get("protocol")?,
            job: state.map(named).transpose()?,
            seed_structure: row.get("seed_structure")?,
            formula: row.get("formula")?,
            atoms: row.get("atoms")?,
        })
    }
}

impl Store {
    /// Every structure that has a label and was not dropped, in decision order, with its job under that protocol.
    /// The campaign need not know the protocol.
    pub async fn relabellable(&self, protocol: ContentHash) -> Result<Vec<Relabellable>> {
        let mut transaction = self.database.begin_read().await?;
        let own = query("SELECT number FROM protocol WHERE hash = $1").bind(protocol.0.to_vec());
        let own: Option<i64> = own.fetch_optional(&mut transaction).await?;
        let found: Vec<Relabellable> =
            query(LABELLED).bind(own.unwrap_or(0)).fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        let mut structures: Vec<Relabellable> = Vec::with_capacity(found.len());
        for one in found {
            match structures.last_mut().filter(|last| last.content == one.content) {
                // The newest job counts.
                Some(last) => *last = one,
                None => structures.push(one),
            }
        }
        Ok(structures)
    }

    /// Number of structures without a label whose jobs have another protocol. They move to this one when it comes
    /// into force.
    pub async fn unlabelled_under_other_protocols(&self, protocol: ContentHash) -> Result<u64> {
        let sql = "SELECT count(*) FROM job WHERE state IN ('queued', 'leased', 'failed')
                   AND protocol <> coalesce((SELECT number FROM protocol WHERE hash = $1), 0)
                   AND NOT EXISTS (SELECT 1 FROM label WHERE label.structure = job.structure
                                   AND label.protocol = job.protocol AND status IN ('label', 'excluded'))";
        query(sql).bind(protocol.0.to_vec()).fetch_one(&self.database).await
    }

    /// Requests new labels for labelled structures, under the protocol in force or under a new protocol that comes
    /// into force. In the latter case all structures without a label move to the new protocol, and running
    /// calculations are lost. Structures that wait already or were dropped stay as they are, so repeating a request
    /// changes nothing. Adds a line `relabel` to the operations log.
    ///
    /// # Errors
    /// [`StoreError::ProtocolName`] if another protocol has the name of the new one. [`StoreError::LockLost`] if
    /// there is a new protocol and another process leads the campaign.
    pub async fn relabel(&self, order: &RelabelRequest<'_>, now: i64) -> Result<RelabelCounts> {
        let mut transaction = match order.protocol {
            Some(_) => self.database.begin_as_leader().await?,
            None => self.database.begin().await?,
        };
        let mut requeued = RelabelCounts::default();
        if let Some(new) = &order.protocol {
            requeued.moved = change_protocol(&mut transaction, new, now).await?;
        }
        let none = || StoreError::damaged("the campaign", "it has no label protocol");
        let protocol = in_force(&mut transaction).await?.ok_or_else(none)?;
        let row = |content: &ContentHash| -> Vec<SqlValue> {
            vec![content.0.to_vec().into(), protocol.into(), order.reason.into()]
        };
        // A statement may write a row only once.
        let mut seen = HashSet::new();
        let rows = order.structures.iter().filter(|content| seen.insert(content.0)).map(row).collect();
        let sql = if order.include_current { REQUEST_INCLUDING_CURRENT } else { REQUEST };
        requeued.relabelling =
            execute_rows(&mut transaction, sql, &["hash", "protocol", "reason"], rows).await?;
        if order.protocol.is_some() || requeued.relabelling > 0 {
            let RelabelCounts { relabelling, moved } = requeued;
            let detail = json!({ "reason": order.reason, "relabelling": relabelling, "moved": moved });
            insert_operation(&mut transaction, now, "relabel", &detail).await?;
        }
        transaction.commit().await?;
        Ok(requeued)
    }
}

/// Whether the tables have the columns for requests; those of an earlier version do not.
pub(crate) async fn has_relabel_columns(transaction: &mut Transaction) -> Result<bool> {
    transaction.has_column("job", "relabel").await
}

/// Number of jobs with an open request for a new label, by state.
pub(super) async fn relabel_requests(transaction: &mut Transaction) -> Result<Vec<(String, u64)>> {
    if !has_relabel_columns(transaction).await? {
        return Ok(Vec::new());
    }
    query(REQUESTED).fetch_all(transaction).await
}

/// Brings a protocol into force. Returns the number of structures without a label that moved to it.
async fn change_protocol(transaction: &mut Transaction, new: &NewProtocol<'_>, now: i64) -> Result<u64> {
    insert_protocol(transaction, new.protocol, now).await?;
    set_campaign_value(transaction, "protocol", &new.protocol.hash.to_string()).await?;
    set_campaign_value(transaction, "configuration_in_force", new.configuration).await?;
    for (name, note) in new.notes {
        set_campaign_value(transaction, &format!("note/{name}"), note).await?;
    }
    for change in new.changes {
        insert_operation(transaction, now, "configuration", change).await?;
    }
    let protocol = protocol_id(transaction, new.protocol.hash).await?;
    query(WITHDRAW_REQUESTS).bind(protocol).execute(&mut *transaction).await?;
    query(MOVE_JOBS).bind(protocol).execute(&mut *transaction).await?;
    let moved = query(SUPERSEDE_UNLABELLED).bind(protocol).execute(&mut *transaction).await?;
    let now = transaction.time(now).await?;
    query(END_ATTEMPTS).bind(now).execute(&mut *transaction).await?;
    Ok(moved)
}

/// Determines the status of a result. A requested label supersedes the labels that it replaces.
pub(super) async fn status_of_result(
    transaction: &mut Transaction,
    structure: i64,
    protocol: i64,
    source: &LabelSource,
    now: i64,
) -> Result<LabelStatus> {
    let labelled = has_label(transaction, structure, protocol).await?;
    let first = if labelled { LabelStatus::Check } else { LabelStatus::Label };
    let sql = "SELECT number, state, relabel, relabel_after FROM job WHERE structure = $1 AND protocol = $2";
    let job = query(sql).bind(structure).bind(protocol).locked();
    let job: Option<RelabelRow> = job.fetch_optional(&mut *transaction).await?;
    let Some(RelabelRow { number, state, relabel, relabel_after }) = job else { return Ok(first) };
    if state == JobState::Superseded.name() {
        return Ok(LabelStatus::Check);
    }
    let Some(reason) = relabel else { return Ok(first) };
    let began_since = match source {
        LabelSource::Attempt { attempt, .. } => *attempt > relabel_after.unwrap_or(0),
        // It may be the doubtful label itself.
        LabelSource::Import { .. } => !labelled,
    };
    if !began_since || state == JobState::Dropped.name() {
        return Ok(LabelStatus::Check);
    }
    query(SUPERSEDE).bind(structure).bind(now).bind(reason).execute(&mut *transaction).await?;
    let came = query("UPDATE job SET relabel = NULL, relabel_after = NULL WHERE number = $1");
    came.bind(number).execute(&mut *transaction).await?;
    query(SUPERSEDE_JOBS).bind(structure).bind(protocol).execute(&mut *transaction).await?;
    query(END_ATTEMPTS).bind(now).execute(&mut *transaction).await?;
    Ok(LabelStatus::Label)
}
