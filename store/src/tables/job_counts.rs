//! Number of label jobs, from counts that triggers keep (`migrations`), and number of labels made.

use super::protocols;
use crate::Store;
use crate::database::{Transaction, query};
use crate::error::{Result, StoreError};
use crate::jobs::OldestLease;
use crate::outcomes::PendingJobs;
use crate::records::JobState;
use wire::ContentHash;

const HOUR: i64 = 3_600_000;

const STATES: &str = "SELECT state, CAST(sum(number) AS BIGINT) FROM job_count GROUP BY state";

/// The same, counted, for tables of an earlier version.
pub(crate) const COUNTED_STATES: &str = "SELECT state, count(*) FROM job GROUP BY state";

const PROTOCOLS: &str = "SELECT protocol.name, state, CAST(sum(job_count.number) AS BIGINT) FROM job_count
    JOIN protocol ON protocol.number = job_count.protocol GROUP BY protocol.number, protocol.name, state
    HAVING sum(job_count.number) > 0 ORDER BY protocol.number, state";

/// The same, counted, for tables of an earlier version.
const COUNTED_PROTOCOLS: &str = "SELECT protocol.name, state, count(*) FROM job
    JOIN protocol ON protocol.number = job.protocol GROUP BY protocol.number, protocol.name, state
    ORDER BY protocol.number, state";

const WAITING: &str = "SELECT seed_structure, formula, atoms, CAST(sum(number) AS BIGINT) FROM job_count
    WHERE state IN ('queued', 'leased') AND protocol = $1 GROUP BY seed_structure, formula, atoms
    HAVING sum(number) > 0";

/// The same, counted, for tables of an earlier version.
const COUNTED_WAITING: &str = "SELECT seed_structure, candidate.formula, candidate.atoms, count(*)
    FROM job CROSS JOIN candidate ON candidate.decision = job.decision
    WHERE job.state IN ('queued', 'leased') AND job.protocol = $1 GROUP BY seed_structure, candidate.formula, candidate.atoms";

/// Jobs of imported structures: their numbers in the queue are above all decisions.
const IMPORTED: &str = "SELECT CAST(coalesce(sum(number), 0) AS BIGINT) FROM job_count
    WHERE state = $1 AND seed_structure = 4294967295";

pub(crate) const OLDEST_LEASE: &str = "SELECT job, holder, started FROM attempt WHERE outcome IS NULL
    ORDER BY started, job LIMIT 1";

pub(crate) const LABELS_SINCE: &str = "SELECT count(*) FROM label WHERE job IS NOT NULL AND received > $1";

/// Compares the stored counts with the rows.
pub(crate) const WRONG: &str = "SELECT count(*), min(coalesce(found.state, kept.state))
    FROM (SELECT protocol, state, coalesce(seed_structure, 4294967295) AS seed_structure, structure.formula AS formula,
              structure.atoms AS atoms, count(*) AS number
          FROM job JOIN structure ON structure.number = job.structure
          LEFT JOIN candidate ON candidate.decision = job.decision GROUP BY 1, 2, 3, 4, 5) AS found
    FULL JOIN job_count AS kept ON kept.protocol = found.protocol AND kept.state = found.state
        AND kept.seed_structure = found.seed_structure AND kept.formula = found.formula AND kept.atoms = found.atoms
    WHERE coalesce(found.number, 0) <> coalesce(kept.number, 0)";

pub(crate) async fn have_counts(transaction: &mut Transaction) -> Result<bool> {
    transaction.has_table("job_count").await
}

/// Number of jobs by state.
pub(super) async fn states(transaction: &mut Transaction) -> Result<Vec<(String, u64)>> {
    let sql = if have_counts(transaction).await? { STATES } else { COUNTED_STATES };
    query(sql).fetch_all(transaction).await
}

/// The running attempt that started first.
pub(super) async fn oldest_lease(transaction: &mut Transaction) -> Result<Option<OldestLease>> {
    query(OLDEST_LEASE).fetch_optional(transaction).await
}

/// Labels made within the hour before `now`.
pub(super) async fn labels_in_last_hour(transaction: &mut Transaction, now: i64) -> Result<u64> {
    let now = transaction.time(now).await?;
    query(LABELS_SINCE).bind(now - HOUR).fetch_one(transaction).await
}

impl Store {
    /// Number of label jobs by protocol name and state, in the order in which protocols were added.
    pub async fn jobs_by_protocol(&self) -> Result<Vec<(String, JobState, u64)>> {
        let mut transaction = self.database.begin_read().await?;
        let sql = if have_counts(&mut transaction).await? { PROTOCOLS } else { COUNTED_PROTOCOLS };
        let rows: Vec<(String, String, u64)> = query(sql).fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        let row = |(protocol, state, number): (String, String, u64)| {
            let known = JobState::named(&state);
            let state = known.ok_or_else(|| StoreError::damaged("the state of a job", state))?;
            Ok((protocol, state, number))
        };
        rows.into_iter().map(row).collect()
    }

    /// Number of jobs of imported structures in that state.
    pub async fn imported_jobs(&self, state: JobState) -> Result<u64> {
        let mut transaction = self.database.begin_read().await?;
        // Tables of a version without counts have no such jobs.
        let number = match have_counts(&mut transaction).await? {
            true => query(IMPORTED).bind(state.name()).fetch_one(&mut transaction).await?,
            false => 0,
        };
        transaction.commit().await?;
        Ok(number)
    }

    /// Unfinished jobs of this protocol, by size.
    pub async fn waiting_jobs(&self, protocol: ContentHash) -> Result<Vec<PendingJobs>> {
        let mut transaction = self.database.begin_read().await?;
        let protocol = protocols::protocol_id(&mut transaction, protocol).await?;
        let sql = if have_counts(&mut transaction).await? { WAITING } else { COUNTED_WAITING };
        let rows: Vec<(u32, String, u32, u64)> =
            query(sql).bind(protocol).fetch_all(&mut transaction).await?;
        transaction.commit().await?;
        let waiting =
            |(seed_structure, formula, atoms, jobs)| PendingJobs { seed_structure, formula, atoms, jobs };
        Ok(rows.into_iter().map(waiting).collect())
    }
}
