//! The label queue: leases, and how they end.

use atoms::Structure;
use wire::ContentHash;

use super::{Store, Transaction, protocols};
use crate::encoding::decode_structure;
use crate::error::{Result, StoreError};
use crate::jobs::Failed;
use crate::records::{JobState, Lease};

/// The next job by priority, then in decision order. One statement: two labellers never get the same job.
pub(super) const LEASE: &str =
    "UPDATE job SET state = 'leased', holder = ?1, expires = ?2, attempts = attempts + 1
    WHERE number = (SELECT number FROM job WHERE state = 'queued' AND protocol = ?3
                    ORDER BY priority DESC, decision LIMIT 1)
    RETURNING number, attempts, structure, decision";

pub(super) const EXPIRED: &str = "SELECT number FROM job WHERE state = 'leased' AND expires <= ?";

pub(super) const UNFINISHED: &str = "SELECT count(*) FROM job WHERE state IN ('queued', 'leased')";

pub(super) const HELD: &str = "SELECT number FROM job WHERE state = 'leased'
    AND (holder = ?1 OR substr(holder, 1, length(?1) + 1) = ?1 || '/')";

/// A job as the ends of its leases need it.
#[derive(sqlx::FromRow)]
pub(super) struct JobRow {
    pub structure: i64,
    pub protocol: i64,
    pub state: String,
    pub attempts: u32,
    pub failures: u32,
}

impl Store {
    /// The next job of that protocol for `holder`, for `seconds` from `now` on. Leases that ran out before now end
    /// first; such a job goes back into the queue, or is given up if `attempt_limit` attempts have failed by then.
    ///
    /// `holder` is `process` or `process/part`, see [`Store::release_stale_leases_of`].
    pub async fn lease(
        &self,
        protocol: ContentHash,
        holder: &str,
        now: i64,
        seconds: u32,
        attempt_limit: u32,
    ) -> Result<Option<Lease>> {
        let mut transaction = self.begin().await?;
        let protocol_number = protocols::number(&mut transaction, protocol).await?;
        let expired: Vec<i64> = sqlx::query_scalar(EXPIRED).bind(now).fetch_all(&mut *transaction).await?;
        for job in expired {
            end_attempt(&mut transaction, job, "expired", now).await?;
            requeue(&mut transaction, job, 1, attempt_limit).await?;
        }
        let expires = now.saturating_add(1000 * i64::from(seconds));
        let leased = sqlx::query_as(LEASE).bind(holder).bind(expires).bind(protocol_number);
        let leased: Option<(i64, u32, i64, i64)> = leased.fetch_optional(&mut *transaction).await?;
        let Some((job, attempt, structure, decision)) = leased else {
            transaction.commit().await?;
            return Ok(None);
        };
        let sql = "INSERT INTO attempt (job, attempt, holder, started) VALUES (?, ?, ?, ?)";
        let query = sqlx::query(sql).bind(job).bind(attempt).bind(holder).bind(now);
        query.execute(&mut *transaction).await?;
        let lease = Lease {
            job,
            attempt,
            holder: holder.to_owned(),
            protocol,
            earlier_calculation: earlier_calculation(&mut transaction, job, attempt).await?,
            structure: structure_of(&mut transaction, structure).await?,
            candidate: candidate_of(&mut transaction, decision).await?,
        };
        transaction.commit().await?;
        Ok(Some(lease))
    }

    /// Makes a lease last for `seconds` from `now` on. Returns whether it is still held: if not, somebody else may
    /// have the job, but a result may still be brought.
    pub async fn renew(&self, lease: &Lease, now: i64, seconds: u32) -> Result<bool> {
        let mut transaction = self.begin().await?;
        let sql = "UPDATE job SET expires = ? WHERE number = ? AND state = 'leased' AND attempts = ?";
        let expires = now.saturating_add(1000 * i64::from(seconds));
        let renewed = sqlx::query(sql).bind(expires).bind(lease.job).bind(lease.attempt);
        let renewed = renewed.execute(&mut *transaction).await?.rows_affected() > 0;
        transaction.commit().await?;
        Ok(renewed)
    }

    /// Stores what finds a calculation again (process group, number in a batch system) before it is started. Whoever
    /// leases the job next gets it as [`Lease::earlier_calculation`].
    pub async fn record_calculation(&self, lease: &Lease, calculation: &str) -> Result<()> {
        let mut transaction = self.begin().await?;
        let sql = "UPDATE attempt SET calculation = ? WHERE job = ? AND attempt = ?";
        let query = sqlx::query(sql).bind(calculation).bind(lease.job).bind(lease.attempt);
        query.execute(&mut *transaction).await?;
        Ok(transaction.commit().await?)
    }

    /// An attempt failed: the job waits for another, or is given up after `attempt_limit` failed ones. Class and
    /// log are kept with the attempt in any case.
    pub async fn fail(
        &self,
        lease: &Lease,
        class: &str,
        log: &str,
        attempt_limit: u32,
        now: i64,
    ) -> Result<Failed> {
        let mut transaction = self.begin().await?;
        let job = job_row(&mut transaction, lease.job).await?;
        let sql = "UPDATE attempt SET class = ?, log = ? WHERE job = ? AND attempt = ?";
        let query = sqlx::query(sql).bind(class).bind(log).bind(lease.job).bind(lease.attempt);
        query.execute(&mut *transaction).await?;
        let failed = if job.state == "leased" && job.attempts == lease.attempt {
            end_attempt(&mut transaction, lease.job, "failed", now).await?;
            match requeue(&mut transaction, lease.job, 1, attempt_limit).await? {
                JobState::Failed => Failed::GivenUp,
                _ => Failed::Requeued,
            }
        } else {
            Failed::LeaseLost
        };
        transaction.commit().await?;
        Ok(failed)
    }

    /// Gives back every lease of `holder` (and of its parts), at a stop in order. Does not count as failed attempts.
    /// Returns their number.
    pub async fn release_all(&self, holder: &str, now: i64) -> Result<usize> {
        self.release(holder, "released", now).await
    }

    /// Takes back every lease of `process` and of its parts (`process/part`), which is known to be dead. Does not count as
    /// failed attempts. Returns their number.
    pub async fn release_stale_leases_of(&self, process: &str, now: i64) -> Result<usize> {
        self.release(process, "lost", now).await
    }

    async fn release(&self, holder: &str, outcome: &str, now: i64) -> Result<usize> {
        let mut transaction = self.begin().await?;
        let jobs: Vec<i64> = sqlx::query_scalar(HELD).bind(holder).fetch_all(&mut *transaction).await?;
        for job in &jobs {
            end_attempt(&mut transaction, *job, outcome, now).await?;
            requeue(&mut transaction, *job, 0, u32::MAX).await?;
        }
        transaction.commit().await?;
        Ok(jobs.len())
    }

    /// Number of jobs that are queued or leased.
    pub async fn unfinished_jobs(&self) -> Result<u64> {
        Ok(sqlx::query_scalar(UNFINISHED).fetch_one(&self.readers).await?)
    }
}

/// Ends the attempt that is under way, if any.
pub(super) async fn end_attempt(
    transaction: &mut Transaction,
    job: i64,
    outcome: &str,
    now: i64,
) -> Result<()> {
    let sql = "UPDATE attempt SET ended = ?, outcome = ? WHERE job = ? AND outcome IS NULL";
    let query = sqlx::query(sql).bind(now).bind(outcome).bind(job);
    query.execute(&mut **transaction).await?;
    Ok(())
}

/// Puts a job back into the queue with `failures` more, or gives it up if that makes `limit`. Returns which.
pub(super) async fn requeue(
    transaction: &mut Transaction,
    job: i64,
    failures: u32,
    limit: u32,
) -> Result<JobState> {
    let failures = job_row(transaction, job).await?.failures + failures;
    let state = if failures >= limit { JobState::Failed } else { JobState::Queued };
    let sql = "UPDATE job SET state = ?, failures = ?, holder = NULL, expires = NULL WHERE number = ?";
    let query = sqlx::query(sql).bind(state.name()).bind(failures).bind(job);
    query.execute(&mut **transaction).await?;
    Ok(state)
}

pub(super) async fn job_row(transaction: &mut Transaction, job: i64) -> Result<JobRow> {
    let sql = "SELECT structure, protocol, state, attempts, failures FROM job WHERE number = ?";
    let row = sqlx::query_as(sql).bind(job).fetch_optional(&mut **transaction).await?;
    row.ok_or_else(|| StoreError::UnknownJob { id: job.to_string(), near: Vec::new() })
}

async fn earlier_calculation(
    transaction: &mut Transaction,
    job: i64,
    attempt: u32,
) -> Result<Option<String>> {
    let sql = "SELECT calculation FROM attempt WHERE job = ? AND attempt = ?
               AND outcome IN ('expired', 'lost', 'released')";
    let query = sqlx::query_scalar(sql).bind(job).bind(attempt - 1);
    let calculation: Option<Option<String>> = query.fetch_optional(&mut **transaction).await?;
    Ok(calculation.flatten())
}

async fn structure_of(transaction: &mut Transaction, number: i64) -> Result<Structure> {
    let sql = "SELECT data, hash FROM structure WHERE number = ?";
    let row = sqlx::query_as(sql).bind(number);
    let (data, hash): (Vec<u8>, Vec<u8>) = row.fetch_one(&mut **transaction).await?;
    decode_structure(&data, &hash)
}

async fn candidate_of(transaction: &mut Transaction, decision: i64) -> Result<String> {
    let id = sqlx::query_scalar("SELECT id FROM candidate WHERE decision = ?").bind(decision);
    Ok(id.fetch_one(&mut **transaction).await?)
}
