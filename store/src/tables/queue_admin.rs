//! Manual changes of the label queue. Each adds an entry to the operations log.

use std::cmp::Ordering;
use std::collections::BTreeMap;

use serde_json::{Value, json};

use super::attempt_end::end_attempt;
use super::exclude;
use super::job_counts;
use super::label_row::LabelRow;
use super::label_values::decode_factors;
use super::logs::insert_operation;
use crate::Store;
use crate::checksum::{CANDIDATE, Names, STRUCTURE, joined};
use crate::database::{FromRow, SqlRow, Transaction, query};
use crate::error::{Result, StoreError};
use crate::jobs::{Attempt, JobDetails, QueueEntry};
use crate::records::JobState;

/// Number of candidates shown if a name fits none or several.
const MAX_SUGGESTIONS: usize = 5;

/// The columns shown of a job besides its own.
macro_rules! columns {
    () => {
        concat!(joined!(candidate), ", protocol.name, coalesce(seed_structure.name, '') AS seed_name")
    };
}

/// The index gives a page; only its jobs are read.
pub(crate) const LIST: &str = concat!(
    "SELECT job.*, ",
    columns!(),
    "
    FROM (SELECT number AS place FROM job WHERE state = $1
          ORDER BY priority DESC, value DESC NULLS LAST, decision LIMIT $2 OFFSET $3) AS page
    CROSS JOIN job ON job.number = place CROSS JOIN candidate ON candidate.decision = job.decision
    CROSS JOIN protocol ON protocol.number = job.protocol
    LEFT JOIN seed_structure ON seed = candidate.seed_structure
    ORDER BY job.priority DESC, job.value DESC NULLS LAST, job.decision"
);

/// The imported structures of the same page.
pub(crate) const LIST_IMPORTS: &str = concat!(
    "SELECT job.*, import.number AS import, protocol.name, ",
    joined!(structure),
    "
    FROM (SELECT number AS place FROM job WHERE state = $1
          ORDER BY priority DESC, value DESC NULLS LAST, decision LIMIT $2 OFFSET $3) AS page
    CROSS JOIN job ON job.number = place CROSS JOIN import ON import.structure = job.structure
        AND job.decision = 1099511627776 + import.number
    CROSS JOIN structure ON structure.number = job.structure
    CROSS JOIN protocol ON protocol.number = job.protocol"
);

/// The order in which jobs of all states are listed: leased, queued, failed, dropped, finished.
const STATES: [JobState; 6] = [
    JobState::Leased,
    JobState::Queued,
    JobState::Failed,
    JobState::Dropped,
    JobState::Labelled,
    JobState::Superseded,
];

const SHOW: &str = concat!(
    "SELECT job.*, ",
    columns!(),
    "
    FROM job CROSS JOIN candidate ON candidate.decision = job.decision
    CROSS JOIN protocol ON protocol.number = job.protocol
    LEFT JOIN seed_structure ON seed = candidate.seed_structure
    WHERE job.number = $1"
);

const SHOW_IMPORT: &str = concat!(
    "SELECT job.*, import.number AS import, protocol.name, ",
    joined!(structure),
    "
    FROM job CROSS JOIN import ON import.structure = job.structure AND job.decision = 1099511627776 + import.number
    CROSS JOIN structure ON structure.number = job.structure
    CROSS JOIN protocol ON protocol.number = job.protocol
    WHERE job.number = $1"
);

/// The newest job of an imported structure.
const FIND_IMPORT: &str = "SELECT coalesce(max(number), 0) FROM job WHERE decision = 1099511627776 + $1";

/// Candidates whose names share a prefix, with the newest job of their structure.
pub(crate) const FIND: &str = "SELECT id, max(job.number) FROM candidate
    CROSS JOIN job ON job.structure = candidate.structure
    WHERE id >= $1 AND id < $1 || '~' GROUP BY id ORDER BY id LIMIT $2";

struct QueueRow {
    number: i64,
    structure: i64,
    decision: i64,
    id: String,
    name: String,
    state: String,
    priority: i32,
    holder: Option<String>,
    expires: Option<i64>,
    attempts: u32,
    failures: u32,
    atoms: u32,
    formula: String,
    selector_gamma: Option<f64>,
    original_gamma: Option<f64>,
    original_gamma_nbr: Option<f64>,
    origin: String,
    seed_name: String,
    walk: u32,
    step: u64,
    temperature: Option<f64>,
    relative_volume: Option<f64>,
    overruled: bool,
    relabel: Option<String>,
    value: Option<f64>,
    value_factors: Option<String>,
}

impl FromRow for QueueRow {
    fn from_row(row: &SqlRow) -> Result<Self> {
        CANDIDATE.verify(row, Names::Joined)?;
        Ok(Self {
            number: row.get("number")?,
            structure: row.get("structure")?,
            decision: row.get("decision")?,
            id: row.get("candidate__id")?,
            name: row.get("name")?,
            state: row.get("state")?,
            priority: row.get("priority")?,
            holder: row.get("holder")?,
            expires: row.get("expires")?,
            attempts: row.get("attempts")?,
            failures: row.get("failures")?,
            atoms: row.get("candidate__atoms")?,
            formula: row.get("candidate__formula")?,
            selector_gamma: row.get("candidate__selector_gamma")?,
            original_gamma: row.get("candidate__original_gamma")?,
            original_gamma_nbr: row.get("candidate__original_gamma_nbr")?,
            origin: row.get("candidate__origin")?,
            seed_name: row.get("seed_name")?,
            walk: row.get("candidate__walk")?,
            step: row.get("candidate__step")?,
            temperature: row.get("candidate__temperature")?,
            relative_volume: row.get("candidate__relative_volume")?,
            overruled: row.get_or_default::<Option<i64>>("overruled")?.is_some(),
            relabel: row.get_or_default("relabel")?,
            value: row.get_or_default("value")?,
            value_factors: row.get_or_default("value_factors")?,
        })
    }
}

/// A job of an imported structure.
struct ImportRow(QueueRow);

impl FromRow for ImportRow {
    fn from_row(row: &SqlRow) -> Result<Self> {
        STRUCTURE.verify(row, Names::Joined)?;
        Ok(Self(QueueRow {
            number: row.get("number")?,
            structure: row.get("structure")?,
            decision: row.get("decision")?,
            id: format!("import-{}", row.get::<i64>("import")?),
            name: row.get("name")?,
            state: row.get("state")?,
            priority: row.get("priority")?,
            holder: row.get("holder")?,
            expires: row.get("expires")?,
            attempts: row.get("attempts")?,
            failures: row.get("failures")?,
            atoms: row.get("structure__atoms")?,
            formula: row.get("structure__formula")?,
            selector_gamma: None,
            original_gamma: None,
            original_gamma_nbr: None,
            origin: "imported".to_owned(),
            seed_name: String::new(),
            walk: 0,
            step: 0,
            temperature: None,
            relative_volume: None,
            overruled: row.get_or_default::<Option<i64>>("overruled")?.is_some(),
            relabel: row.get_or_default("relabel")?,
            value: row.get_or_default("value")?,
            value_factors: row.get_or_default("value_factors")?,
        }))
    }
}

impl Store {
    /// Jobs in a state, in the order in which they would be leased: by priority, then by value, then in decision order. Without a
    /// state, all jobs: leased first, then queued, failed, dropped and finished ones.
    pub async fn queue_list(
        &self,
        state: Option<JobState>,
        limit: u32,
        offset: u32,
    ) -> Result<Vec<QueueEntry>> {
        let mut transaction = self.database.begin_read().await?;
        let numbers = job_counts::states(&mut transaction).await?;
        let excluded = exclude::by_job(&mut transaction).await?;
        let number =
            |state: JobState| numbers.iter().find(|(name, _)| name == state.name()).map_or(0, |(_, n)| *n);
        let (mut jobs, mut skipped) = (Vec::new(), u64::from(offset));
        for state in STATES.into_iter().filter(|listed| state.is_none_or(|state| state == *listed)) {
            let (room, there) = (u64::from(limit) - jobs.len() as u64, number(state));
            if room > 0 && skipped < there {
                let page = |sql| query(sql).bind(state.name()).bind(room as i64).bind(skipped as i64);
                let mut rows: Vec<QueueRow> = page(LIST).fetch_all(&mut transaction).await?;
                let imports: Vec<ImportRow> = page(LIST_IMPORTS).fetch_all(&mut transaction).await?;
                rows.extend(imports.into_iter().map(|ImportRow(row)| row));
                rows.sort_by(QueueRow::by_lease);
                let rows = rows.into_iter().map(|row| row.into_job(&excluded));
                jobs.extend(rows.collect::<Result<Vec<_>>>()?);
            }
            skipped = skipped.saturating_sub(there);
        }
        transaction.commit().await?;
        Ok(jobs)
    }

    /// Finds a job by its candidate's name or a prefix of it, or by the name of an imported structure. The campaign's part of the name may be omitted.
    pub async fn queue_show(&self, id: &str) -> Result<JobDetails> {
        let (job, _) = self.find(id).await?;
        self.job_details(job).await
    }

    pub(super) async fn job_details(&self, job: i64) -> Result<JobDetails> {
        let row = match query(SHOW).bind(job).fetch_optional(&self.database).await? {
            Some(row) => row,
            None => query(SHOW_IMPORT).bind(job).fetch_one::<ImportRow>(&self.database).await?.0,
        };
        let attempts = query("SELECT * FROM attempt WHERE job = $1 ORDER BY attempt").bind(job);
        let attempts: Vec<Attempt> = attempts.fetch_all(&self.database).await?;
        let sql = "SELECT * FROM label WHERE structure = $1
                   AND protocol = (SELECT protocol FROM job WHERE number = $2) ORDER BY number";
        let labels = query(sql).bind(row.structure).bind(job);
        let labels: Vec<LabelRow> = labels.fetch_all(&self.database).await?;
        let results: Vec<_> = labels.into_iter().map(LabelRow::into_record).collect::<Result<_>>()?;
        let excluded = exclude::by_job(&mut self.database.begin_read().await?).await?;
        Ok(JobDetails {
            job: row.into_job(&excluded)?,
            attempts_made: attempts,
            energies: results.iter().map(|result| (result.status, result.label.energy)).collect(),
            retry_adjustments: results
                .into_iter()
                .map(|result| result.label.details.retry_adjustments)
                .collect(),
        })
    }

    /// Removes a candidate from the queue and from exports. Returns its full name.
    pub async fn drop_job(&self, id: &str, now: i64) -> Result<String> {
        use JobState::{Failed, Leased, Queued};
        let allowed = [Queued, Leased, Failed];
        let mut change = self.change("drop", id, &allowed, "queued, leased and failed").await?;
        end_attempt(&mut change.transaction, change.job, "dropped", now).await?;
        let sql = "UPDATE job SET state = 'dropped', holder = NULL, expires = NULL WHERE number = $1";
        query(sql).bind(change.job).execute(&mut change.transaction).await?;
        change.log("drop", json!({}), now).await
    }

    /// Requeues a failed or dropped candidate with all its attempts left and past any guard. A dropped candidate
    /// that has a label meanwhile is done. Returns its full name.
    pub async fn retry_job(&self, id: &str, now: i64) -> Result<String> {
        let allowed = [JobState::Failed, JobState::Dropped];
        let mut change = self.change("retry", id, &allowed, "failed and dropped").await?;
        let sql = "UPDATE job SET failures = 0, overruled = 1, value = NULL, value_factors = NULL, state = CASE WHEN EXISTS (
                       SELECT 1 FROM label WHERE label.structure = job.structure
                       AND label.protocol = job.protocol AND status IN ('label', 'excluded')
                   ) THEN 'labelled' ELSE 'queued' END WHERE number = $1";
        query(sql).bind(change.job).execute(&mut change.transaction).await?;
        change.log("retry", json!({}), now).await
    }

    /// Changes the priority of a waiting candidate (higher first). A leased one keeps it if it returns to the
    /// queue. Returns its full name.
    pub async fn prioritise_job(&self, id: &str, priority: i32, now: i64) -> Result<String> {
        let allowed = [JobState::Queued, JobState::Leased];
        let mut change = self.change("prioritise", id, &allowed, "queued and leased").await?;
        let sql = "UPDATE job SET priority = $1 WHERE number = $2";
        query(sql).bind(priority).bind(change.job).execute(&mut change.transaction).await?;
        change.log("prioritise", json!({ "priority": priority }), now).await
    }

    async fn change(
        &self,
        action: &'static str,
        id: &str,
        allowed: &[JobState],
        allowed_text: &'static str,
    ) -> Result<PendingChange> {
        let (job, candidate) = self.find(id).await?;
        let mut transaction = self.database.begin().await?;
        let state = query("SELECT state FROM job WHERE number = $1").bind(job);
        let state = parse_state(state.locked().fetch_one(&mut transaction).await?)?;
        if !allowed.contains(&state) {
            return Err(StoreError::WrongState { action, candidate, state, allowed: allowed_text });
        }
        Ok(PendingChange { transaction, job, candidate })
    }

    /// Job id, and full name of the candidate.
    async fn find(&self, id: &str) -> Result<(i64, String)> {
        if let Some(number) = id.strip_prefix("import-").and_then(|number| number.parse::<i64>().ok()) {
            let job: i64 = query(FIND_IMPORT).bind(number).fetch_one(&self.database).await?;
            let unknown = || StoreError::UnknownJob { id: id.into(), near: Vec::new() };
            return (job > 0).then(|| (job, id.to_owned())).ok_or_else(unknown);
        }
        let campaign = self.campaign_value("id").await?;
        let campaign = campaign.get(..8).unwrap_or_default();
        let mut found = self.jobs_with_prefix(id).await?;
        if found.is_empty() {
            found = self.jobs_with_prefix(&format!("{campaign}-{id}")).await?;
        }
        let exact = found.iter().position(|(candidate, _)| candidate == id);
        match (exact, found.as_slice()) {
            (Some(k), _) => Ok((found[k].1, found.swap_remove(k).0)),
            (None, [(candidate, job)]) => Ok((*job, candidate.clone())),
            (None, []) => {
                Err(StoreError::UnknownJob { id: id.into(), near: self.similar_ids(campaign, id).await? })
            }
            (None, _) => {
                let matches = found.into_iter().map(|(candidate, _)| candidate).collect();
                Err(StoreError::AmbiguousJob { id: id.into(), matches })
            }
        }
    }

    async fn jobs_with_prefix(&self, begin: &str) -> Result<Vec<(String, i64)>> {
        let query = query(FIND).bind(begin).bind(MAX_SUGGESTIONS as i64);
        query.fetch_all(&self.database).await
    }

    /// Candidates whose names share the longest prefix with `id`.
    async fn similar_ids(&self, campaign: &str, id: &str) -> Result<Vec<String>> {
        let full = if id.starts_with(campaign) { id.to_owned() } else { format!("{campaign}-{id}") };
        for (end, _) in full.char_indices().rev() {
            let found = self.jobs_with_prefix(&full[..end]).await?;
            if !found.is_empty() {
                return Ok(found.into_iter().map(|(candidate, _)| candidate).collect());
            }
        }
        Ok(Vec::new())
    }
}

/// A permitted change that is not yet made.
struct PendingChange {
    transaction: Transaction,
    job: i64,
    candidate: String,
}

impl PendingChange {
    async fn log(mut self, action: &str, mut detail: Value, now: i64) -> Result<String> {
        detail["candidate"] = json!(self.candidate);
        detail["job"] = json!(self.job);
        insert_operation(&mut self.transaction, now, action, &detail).await?;
        self.transaction.commit().await?;
        Ok(self.candidate)
    }
}

impl QueueRow {
    /// Order in which jobs of one state would be leased.
    fn by_lease(&self, other: &Self) -> Ordering {
        // Values are not negative.
        let value = |row: &Self| row.value.unwrap_or(-1.0);
        let by_priority = other.priority.cmp(&self.priority);
        by_priority.then(value(other).total_cmp(&value(self))).then(self.decision.cmp(&other.decision))
    }

    fn into_job(self, excluded: &BTreeMap<i64, String>) -> Result<QueueEntry> {
        Ok(QueueEntry {
            job: self.number,
            candidate: self.id,
            protocol: self.name,
            state: parse_state(self.state)?,
            priority: self.priority,
            holder: self.holder,
            expires: self.expires,
            attempts: self.attempts,
            failures: self.failures,
            atoms: self.atoms,
            formula: self.formula,
            selector_gamma: self.selector_gamma,
            original_gamma: self.original_gamma,
            original_gamma_nbr: self.original_gamma_nbr,
            origin: self.origin,
            seed_structure: self.seed_name,
            walk: self.walk,
            step: self.step,
            temperature: self.temperature,
            relative_volume: self.relative_volume,
            overruled: self.overruled,
            relabel: self.relabel,
            value: self.value,
            value_factors: decode_factors(self.value_factors.as_deref())?,
            excluded: excluded.get(&self.number).cloned(),
        })
    }
}

fn parse_state(name: String) -> Result<JobState> {
    JobState::named(&name).ok_or_else(|| StoreError::damaged("the state of a job", name))
}
