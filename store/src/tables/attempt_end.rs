//! The end of an attempt to make a label, and what becomes of its job.

use super::structures::has_label;
use crate::database::{Transaction, from_columns, query};
use crate::error::{Result, StoreError};
use crate::records::JobState;

/// Number of attempts of a job lost in a row, counted from the last time it failed for that reason.
pub(crate) const LOSSES: &str = "SELECT count(*) FROM attempt WHERE job = $1 AND attempt > (
        SELECT coalesce(max(attempt), 0) FROM attempt WHERE job = $1
        AND (outcome NOT IN ('released', 'lost', 'expired') OR class = 'lost_too_often'))";

/// Attempts that may be lost in a row. If labellers are killed at random during half of the attempts, one job
/// reaches this number with probability 3 × 10⁻⁸.
const LOSS_LIMIT: u32 = 25;

/// Failure class of the attempt that reaches the limit.
const LOST_TOO_OFTEN: &str = "lost_too_often";

/// How an attempt without a label ended.
#[derive(Clone, Copy)]
pub(crate) enum AttemptEnd<'a> {
    /// It failed: the job fails after `limit` of these.
    Failed { class: &'a str, log: &'a str, limit: u32 },
    /// Its labeller no longer works on it: `released`, `lost` or `expired`.
    Lost(&'static str),
}

/// The columns of a job that the end of a lease needs.
pub(super) struct JobRow {
    pub structure: i64,
    pub protocol: i64,
    pub state: String,
    pub attempts: u32,
    pub failures: u32,
}

from_columns!(JobRow { structure, protocol, state, attempts, failures });

/// Ends the running attempt, if any.
pub(super) async fn end_attempt(
    transaction: &mut Transaction,
    job: i64,
    outcome: &str,
    now: i64,
) -> Result<()> {
    let sql = "UPDATE attempt SET ended = $1, outcome = $2 WHERE job = $3 AND outcome IS NULL";
    let query = query(sql).bind(now).bind(outcome).bind(job);
    query.execute(&mut *transaction).await?;
    Ok(())
}

/// Ends the running attempt without a label: the job waits for another, or fails. Returns the state of the job.
pub(crate) async fn end_without_label(
    transaction: &mut Transaction,
    job: i64,
    how: AttemptEnd<'_>,
    now: i64,
) -> Result<JobState> {
    let JobRow { structure, protocol, attempts, mut failures, .. } = job_row(transaction, job).await?;
    let given_up = match how {
        AttemptEnd::Failed { class, log, limit } => {
            end_attempt(transaction, job, "failed", now).await?;
            record_failure(transaction, job, attempts, class, log).await?;
            failures += 1;
            failures >= limit
        }
        AttemptEnd::Lost(outcome) => {
            end_attempt(transaction, job, outcome, now).await?;
            let losses: u32 = query(LOSSES).bind(job).fetch_one(&mut *transaction).await?;
            if losses >= LOSS_LIMIT {
                let log =
                    format!("{losses} attempts in a row were lost without a message from their labellers");
                record_failure(transaction, job, attempts, LOST_TOO_OFTEN, &log).await?;
            }
            losses >= LOSS_LIMIT
        }
    };
    let state = match given_up {
        false => JobState::Queued,
        // The requested new label could not be made; the existing one stays.
        true if has_label(transaction, structure, protocol).await? => JobState::Labelled,
        true => JobState::Failed,
    };
    let sql = "UPDATE job SET state = $1, failures = $2, holder = NULL, expires = NULL WHERE number = $3";
    let query = query(sql).bind(state.name()).bind(failures).bind(job);
    query.execute(&mut *transaction).await?;
    Ok(state)
}

/// Stores with an attempt why it failed.
pub(super) async fn record_failure(
    transaction: &mut Transaction,
    job: i64,
    attempt: u32,
    class: &str,
    log: &str,
) -> Result<()> {
    let sql = "UPDATE attempt SET class = $1, log = $2 WHERE job = $3 AND attempt = $4";
    let query = query(sql).bind(class).bind(log).bind(job).bind(attempt);
    query.execute(&mut *transaction).await?;
    Ok(())
}

/// Reads a job and locks it until the end of the transaction.
pub(super) async fn job_row(transaction: &mut Transaction, job: i64) -> Result<JobRow> {
    let sql = "SELECT structure, protocol, state, attempts, failures FROM job WHERE number = $1";
    let row = query(sql).bind(job).locked().fetch_optional(&mut *transaction).await?;
    row.ok_or_else(|| StoreError::UnknownJob { id: job.to_string(), near: Vec::new() })
}
