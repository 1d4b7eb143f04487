//! Values of queued labels: what they are computed from, and their place in the queue.

use std::collections::BTreeMap;

use serde_json::Value;
use wire::ContentHash;

use super::restore::grades;
use super::{protocols, walk_conditions};
use crate::Store;
use crate::checksum::{CANDIDATE, FEATURES, Names, ORIGINAL_GRADES, joined};
use crate::database::{FromRow, SqlRow, SqlValue, execute_rows, query};
use crate::encoding::read_structure;
use crate::error::{Result, StoreError};
use crate::label_values::{FinishedStructure, LabelValue, QueuedStructure};
use crate::numbers::decode_numbers;

/// The newest, each with the walk that found it first. Without excluded labels, structures that `label.guard` rejected (their
/// calculations never began), and imported structures.
pub(crate) const FINISHED: &str = concat!(
    "SELECT job.state AS job_state, ",
    joined!(candidate),
    ", ",
    joined!(structure),
    " FROM (SELECT job.number AS place FROM job CROSS JOIN candidate ON candidate.decision = job.decision
          WHERE job.state IN ('labelled', 'failed') AND job.protocol = $1 AND candidate.walk >= $2 AND candidate.walk < $3
          AND NOT EXISTS (SELECT 1 FROM label WHERE label.structure = job.structure AND label.protocol = job.protocol
                          AND status = 'excluded')
          AND NOT (job.state = 'failed' AND EXISTS (SELECT 1 FROM attempt WHERE attempt.job = job.number
                   AND attempt.attempt = job.attempts AND class = 'rejected_by_label_guard'))
          ORDER BY job.decision DESC LIMIT $4) AS page
    CROSS JOIN job ON job.number = place
    CROSS JOIN candidate ON candidate.decision = job.decision
    CROSS JOIN structure ON structure.number = job.structure
    ORDER BY job.decision DESC"
);

/// The oldest of the highest priority. Jobs of imported structures, whose numbers are above all decisions, are left out.
pub(crate) const QUEUED: &str = concat!(
    "SELECT job.number AS job_number, job.priority AS job_priority, job.state AS job_state, candidate.decision AS decision, original_checksum, original_grades, ",
    joined!(candidate),
    ", ",
    joined!(structure),
    " FROM (SELECT number AS place FROM job WHERE state IN ('queued', 'leased') AND protocol = $1 AND decision < 1099511627776
          ORDER BY priority DESC, decision LIMIT $2) AS page
    CROSS JOIN job ON job.number = place
    CROSS JOIN candidate ON candidate.decision = job.decision
    CROSS JOIN candidate_data ON candidate_data.decision = job.decision
    CROSS JOIN structure ON structure.number = job.structure
    ORDER BY job.priority DESC, job.decision"
);

/// Finished structures that were found after a decision.
pub(crate) const FINISHED_AFTER: &str = "SELECT priority, decision FROM job
    WHERE state IN ('labelled', 'failed') AND protocol = $1 AND decision > $2 AND decision < 1099511627776";

const FEATURES_OF: &str = "SELECT candidate.decision AS decision, features, features_checksum
    FROM candidate CROSS JOIN candidate_data ON candidate_data.decision = candidate.decision
    WHERE candidate.decision = $1";

const SET: &str = "UPDATE job SET value = new.value, value_factors = new.factors FROM {rows}
    WHERE job.number = new.number AND job.state = 'queued' AND (job.value IS NULL OR job.value <> new.value)";

const COLUMNS: [&str; 3] = ["number", "value", "factors"];

const CLEAR: &str =
    "UPDATE job SET value = NULL, value_factors = NULL WHERE state = 'queued' AND value IS NOT NULL";

impl FromRow for FinishedStructure {
    fn from_row(row: &SqlRow) -> Result<Self> {
        CANDIDATE.verify(row, Names::Joined)?;
        Ok(Self {
            decision: row.get("candidate__decision")?,
            walk: row.get("candidate__walk")?,
            seed_structure: row.get("candidate__seed_structure")?,
            labelled: row.get::<String>("job_state")? == "labelled",
            gamma: row.get("candidate__original_gamma")?,
            relative_volume: row.get("candidate__relative_volume")?,
            structure: read_structure(row)?,
        })
    }
}

impl FromRow for QueuedStructure {
    fn from_row(row: &SqlRow) -> Result<Self> {
        CANDIDATE.verify(row, Names::Joined)?;
        ORIGINAL_GRADES.verify(row)?;
        Ok(Self {
            job: row.get("job_number")?,
            decision: row.get("candidate__decision")?,
            walk: row.get("candidate__walk")?,
            seed_structure: row.get("candidate__seed_structure")?,
            formula: row.get("candidate__formula")?,
            priority: row.get("job_priority")?,
            leased: row.get::<String>("job_state")? == "leased",
            relative_volume: row.get("candidate__relative_volume")?,
            original: grades(row.get::<Option<Vec<u8>>>("original_grades")?.as_deref())?,
            overtaken: 0,
            structure: read_structure(row)?,
        })
    }
}

impl Store {
    /// Structures whose label jobs of this protocol are finished and whose walks had this version of the potential (`None`: any),
    /// newest first, at most `limit`.
    pub async fn finished_structures(
        &self,
        protocol: ContentHash,
        version: Option<u32>,
        limit: u32,
    ) -> Result<Vec<FinishedStructure>> {
        let mut transaction = self.database.begin_read().await?;
        let protocol = protocols::protocol_id(&mut transaction, protocol).await?;
        let walks = match version {
            Some(version) => walk_conditions::versions(&mut transaction).await?.walks_of(version),
            None => 0..i64::MAX,
        };
        let found = query(FINISHED).bind(protocol).bind(walks.start).bind(walks.end).bind(limit);
        let found = found.fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        Ok(found)
    }

    /// Structures that wait for a label of this protocol, or whose label is in work: the oldest of the highest priority, at
    /// most `limit`.
    pub async fn queued_structures(&self, protocol: ContentHash, limit: u32) -> Result<Vec<QueuedStructure>> {
        let mut transaction = self.database.begin_read().await?;
        let protocol = protocols::protocol_id(&mut transaction, protocol).await?;
        let queued = query(QUEUED).bind(protocol).bind(limit);
        let mut queued: Vec<QueuedStructure> = queued.fetch_all(&mut transaction).await?;
        let Some(oldest) = queued.iter().map(|found| found.decision).min() else { return Ok(queued) };
        let later = query(FINISHED_AFTER).bind(protocol).bind(oldest);
        let later: Vec<(i32, i64)> = later.fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        let mut by_priority: BTreeMap<i32, Vec<i64>> = BTreeMap::new();
        for (priority, decision) in later {
            by_priority.entry(priority).or_default().push(decision);
        }
        by_priority.values_mut().for_each(|decisions| decisions.sort_unstable());
        for found in &mut queued {
            let decisions = by_priority.get(&found.priority).map_or(&[][..], Vec::as_slice);
            let before = decisions.partition_point(|decision| *decision <= found.decision);
            found.overtaken = (decisions.len() - before) as u64;
        }
        Ok(queued)
    }

    /// Features of a candidate, [n × D]; `None` if they were not stored.
    pub async fn features_of(&self, decision: i64) -> Result<Option<Vec<f64>>> {
        let rows = query(FEATURES_OF).bind(decision).rows(&self.database).await?;
        let Some(row) = rows.first() else { return Ok(None) };
        FEATURES.verify(row)?;
        let features: Option<Vec<u8>> = row.get("features")?;
        Ok(features.map(|bytes| decode_numbers(&bytes)).transpose()?)
    }

    /// Sets the values of those of these jobs that are queued, in one transaction. NaN and negative values count as 0. Returns
    /// the number of jobs whose value changed: only these are locked.
    pub async fn set_label_values(&self, values: &[LabelValue]) -> Result<u64> {
        let row = |found: &LabelValue| -> Vec<SqlValue> {
            let value = found.value.clamp(0.0, f64::MAX);
            let value = if value.is_nan() { 0.0 } else { value };
            vec![found.job.into(), value.into(), found.factors.to_string().into()]
        };
        let mut transaction = self.database.begin_as_leader().await?;
        let set = execute_rows(&mut transaction, SET, &COLUMNS, values.iter().map(row).collect()).await?;
        transaction.commit().await?;
        Ok(set)
    }

    /// Removes the values of all queued jobs: they are leased in the order in which their structures were found. Returns their
    /// number.
    pub async fn clear_label_values(&self) -> Result<u64> {
        let mut transaction = self.database.begin_as_leader().await?;
        let cleared = query(CLEAR).execute(&mut transaction).await?;
        transaction.commit().await?;
        Ok(cleared)
    }
}

/// The factors of a value as JSON.
pub(super) fn decode_factors(text: Option<&str>) -> Result<Option<Value>> {
    let factors = text.map(serde_json::from_str).transpose();
    factors.map_err(|error| StoreError::damaged("the factors of a job's value", error))
}
