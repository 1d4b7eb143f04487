//! The label queue: leases, and how they end.
//!
//! An attempt without a label ends in one of two ways. It *failed* if its labeller says so or crashed because of
//! it; after a few failures the job fails. It was *lost* if its labeller ended or stopped responding, which says
//! nothing about the job. A job that exhausts the memory of its labellers looks the same, since the system kills
//! them: after [`LOSS_LIMIT`] losses in a row, the job fails as well.

use atoms::Structure;
use wire::ContentHash;

use super::attempt_end::{AttemptEnd, end_without_label, job_row, record_failure};
use super::{budget, processes, protocols};
use crate::Store;
use crate::checksum::joined;
use crate::database::{Transaction, from_columns, query};
use crate::encoding::read_structure;
use crate::error::{Result, StoreError};
use crate::jobs::{CalculationRecord, FailOutcome, LeaseStatus};
use crate::processes::ProcessRecord;
use crate::records::{JobState, Lease};

/// The next job by priority, then by value, then in decision order.
pub(crate) const NEXT: &str =
    "SELECT number, structure, decision, attempts, failures, overruled, value FROM job
    WHERE state = 'queued' AND protocol = $1 ORDER BY priority DESC, value DESC NULLS LAST, decision LIMIT 1";

pub(crate) const EXPIRED: &str = "SELECT number, holder FROM job WHERE state = 'leased' AND expires <= $1";

pub(crate) const UNFINISHED: &str = "SELECT (SELECT count(*) FROM job WHERE state IN ('queued', 'leased'))
    - (SELECT count(*) FROM job WHERE state IN ('queued', 'leased') AND relabel IS NOT NULL)";

pub(crate) const HELD: &str = "SELECT number FROM job WHERE state = 'leased'
    AND (holder = $1 OR substr(holder, 1, length($1) + 1) = $1 || '/')";

/// Leases of exactly this holder, not of its parts.
pub(crate) const HELD_BY: &str = "SELECT number, attempts FROM job WHERE state = 'leased' AND holder = $1";

/// The adjustments with which an earlier attempt started a calculation, and their effect on its input.
const STARTED_WITH: &str = "SELECT remedies, difference FROM attempt
    WHERE job = $1 AND attempt < $2 AND calculation = $3 ORDER BY attempt LIMIT 1";

/// A job that may be leased.
struct NextJob {
    number: i64,
    structure: i64,
    decision: i64,
    attempts: u32,
    failures: u32,
    overruled: Option<i64>,
    value: Option<f64>,
}

from_columns!(NextJob { number, structure, decision, attempts, failures, overruled, value });

impl Store {
    /// Leases the next job of that protocol to `holder` (`process` or `process/part`), for `seconds` from `now` on: of the
    /// highest priority, and of these the one of the largest value ([`Store::set_label_values`]) or the oldest.
    /// Returns `None` if the queue is empty or the campaign's budget ([`Store::set_budget`]) is used up.
    ///
    /// First, expired leases end and their jobs return to the queue; this does not count as a failed attempt. The
    /// wall clock alone does not end a lease: after a suspend every lease has expired, and the first process to
    /// resume must not take the jobs of the others. A lease therefore continues while its holder may be at work: a
    /// local process that runs and sent a heartbeat within a day, or a process elsewhere that sent a heartbeat
    /// within `seconds`. On a server, the server's clock counts instead of `now`.
    pub async fn lease(
        &self,
        protocol: ContentHash,
        holder: &str,
        now: i64,
        seconds: u32,
    ) -> Result<Option<Lease>> {
        let mut transaction = self.database.begin().await?;
        let protocol_number = protocols::protocol_id(&mut transaction, protocol).await?;
        let now = transaction.time(now).await?;
        end_expired(&mut transaction, now, seconds).await?;
        if budget::forbids_attempts(&mut transaction, now).await? {
            transaction.commit().await?;
            return Ok(None);
        }
        let next = query(NEXT).bind(protocol_number).skip_locked();
        let next: Option<NextJob> = next.fetch_optional(&mut transaction).await?;
        let Some(next) = next else {
            transaction.commit().await?;
            return Ok(None);
        };
        let (job, attempt) = (next.number, next.attempts + 1);
        let sql =
            "UPDATE job SET state = 'leased', holder = $1, expires = $2, attempts = $3 WHERE number = $4";
        let lease = query(sql).bind(holder).bind(lease_expiry(now, seconds)).bind(attempt).bind(job);
        lease.execute(&mut transaction).await?;
        let sql = "INSERT INTO attempt (job, attempt, holder, started) VALUES ($1, $2, $3, $4)";
        let insert = query(sql).bind(job).bind(attempt).bind(holder).bind(now);
        insert.execute(&mut transaction).await?;
        let (candidate, model_energy) = candidate_of(&mut transaction, &next).await?;
        let lease = Lease {
            job,
            attempt,
            holder: holder.to_owned(),
            protocol,
            earlier_calculations: earlier_calculations(&mut transaction, job, attempt).await?,
            failures: classes_of_failures(&mut transaction, job, next.failures).await?,
            failed_calculations: failed_calculations(&mut transaction, job).await?,
            overruled: next.overruled.is_some(),
            ordered_by_value: next.value.is_some(),
            structure: structure_of(&mut transaction, next.structure).await?,
            candidate,
            model_energy,
        };
        transaction.commit().await?;
        Ok(Some(lease))
    }

    /// Declares that `holder` holds these leases and no others. All its other leases return to the queue, without
    /// counting as failed attempts: a lease or a release whose reply was lost is unknown to its holder and would
    /// otherwise last as long as the holder. Returns the number of leases released.
    ///
    /// A holder must not call this and [`Self::lease`] concurrently: it would release the lease that it is about to
    /// get.
    pub async fn state_leases(&self, holder: &str, held: &[&Lease], now: i64) -> Result<usize> {
        let is_stated = |(job, attempt): &(i64, u32)| {
            held.iter().any(|lease| (lease.job, lease.attempt) == (*job, *attempt))
        };
        // Usually there is nothing to release, and nothing is written.
        let found: Vec<(i64, u32)> = query(HELD_BY).bind(holder).fetch_all(&self.database).await?;
        if found.iter().all(is_stated) {
            return Ok(0);
        }
        let mut transaction = self.database.begin().await?;
        let now = transaction.time(now).await?;
        let mut found: Vec<(i64, u32)> =
            query(HELD_BY).bind(holder).locked().fetch_all(&mut transaction).await?;
        found.retain(|lease| !is_stated(lease));
        for (job, _) in &found {
            end_without_label(&mut transaction, *job, AttemptEnd::Lost("lost"), now).await?;
        }
        transaction.commit().await?;
        Ok(found.len())
    }

    /// Extends a lease to `seconds` from `now` on. Returns whether it is still held. If not, another holder may
    /// have the job, but a result may still be delivered.
    pub async fn renew(&self, lease: &Lease, now: i64, seconds: u32) -> Result<bool> {
        let mut transaction = self.database.begin().await?;
        let sql = "UPDATE job SET expires = $1 WHERE number = $2 AND state = 'leased' AND attempts = $3";
        let expires = lease_expiry(transaction.time(now).await?, seconds);
        let renewed = query(sql).bind(expires).bind(lease.job).bind(lease.attempt);
        let renewed = renewed.execute(&mut transaction).await? > 0;
        transaction.commit().await?;
        Ok(renewed)
    }

    /// Records what identifies a calculation (process, id in a batch system) and its properties, before it is
    /// started. The next holder of the job finds it in [`Lease::earlier_calculations`]. A calculation that an
    /// earlier attempt started belongs to this attempt from now on: its core-seconds count here, with the adjustments
    /// with which it was started.
    pub async fn record_calculation(
        &self,
        lease: &Lease,
        calculation: &str,
        made: &CalculationRecord,
    ) -> Result<()> {
        let mut transaction = self.database.begin().await?;
        let started = query(STARTED_WITH).bind(lease.job).bind(lease.attempt).bind(calculation);
        let started: Option<(Option<String>, Option<String>)> =
            started.fetch_optional(&mut transaction).await?;
        let (remedies, difference) = started.unwrap_or((made.remedies.clone(), made.difference.clone()));
        let sql =
            "UPDATE attempt SET calculation = $1, cores = $2, remedies = $3, difference = $4, atoms = $5,
                   electrons = $6, k_points = $7 WHERE job = $8 AND attempt = $9";
        let record = query(sql).bind(calculation).bind(made.cores).bind(remedies).bind(difference);
        let record = record.bind(made.atoms);
        let record = record.bind(made.electrons).bind(made.k_points).bind(lease.job).bind(lease.attempt);
        record.execute(&mut transaction).await?;
        let sql = "UPDATE attempt SET core_seconds = 0 WHERE job = $1 AND attempt < $2 AND calculation = $3";
        let before = query(sql).bind(lease.job).bind(lease.attempt).bind(calculation);
        before.execute(&mut transaction).await?;
        transaction.commit().await
    }

    /// Records the core-seconds of a calculation that has ended, and the end of its output.
    pub async fn record_cost(&self, lease: &Lease, core_seconds: f64, log: &str) -> Result<()> {
        let mut transaction = self.database.begin().await?;
        let sql = "UPDATE attempt SET core_seconds = $1, log = $2 WHERE job = $3 AND attempt = $4";
        let account = query(sql).bind(core_seconds).bind(log).bind(lease.job).bind(lease.attempt);
        account.execute(&mut transaction).await?;
        transaction.commit().await
    }

    /// The state of a lease that may have been lost.
    pub async fn lease_status(&self, lease: &Lease) -> Result<LeaseStatus> {
        let sql = "SELECT state, attempts, calculation FROM job
                   LEFT JOIN attempt ON attempt.job = job.number AND attempt.attempt = attempts
                   WHERE job.number = $1";
        let row: Option<(String, u32, Option<String>)> =
            query(sql).bind(lease.job).fetch_optional(&self.database).await?;
        let unknown = || StoreError::UnknownJob { id: lease.candidate.clone(), near: Vec::new() };
        let (state, attempts, calculation) = row.ok_or_else(unknown)?;
        Ok(match state.as_str() {
            "leased" if attempts == lease.attempt => LeaseStatus::Held,
            "leased" => LeaseStatus::LeasedAgain { calculation },
            "queued" => LeaseStatus::Queued,
            _ => LeaseStatus::Over,
        })
    }

    /// Ends an attempt that was lost for a known reason that is not the job's fault: the job waits for another
    /// attempt.
    pub async fn release_lost(&self, lease: &Lease, class: &str, log: &str, now: i64) -> Result<FailOutcome> {
        let mut transaction = self.database.begin().await?;
        let now = transaction.time(now).await?;
        let job = job_row(&mut transaction, lease.job).await?;
        let held = job.state == "leased" && job.attempts == lease.attempt;
        record_failure(&mut transaction, lease.job, lease.attempt, class, log).await?;
        let lost = match held {
            false => FailOutcome::LeaseLost,
            true => {
                match end_without_label(&mut transaction, lease.job, AttemptEnd::Lost("lost"), now).await? {
                    JobState::Queued => FailOutcome::Requeued,
                    _ => FailOutcome::Failed,
                }
            }
        };
        transaction.commit().await?;
        Ok(lost)
    }

    /// Ends an attempt that failed: the job waits for another attempt, or fails after `attempt_limit` of them.
    /// Class and log are stored with the attempt in any case.
    pub async fn fail(
        &self,
        lease: &Lease,
        class: &str,
        log: &str,
        attempt_limit: u32,
        now: i64,
    ) -> Result<FailOutcome> {
        let mut transaction = self.database.begin().await?;
        let now = transaction.time(now).await?;
        let job = job_row(&mut transaction, lease.job).await?;
        let failed = if job.state == "leased" && job.attempts == lease.attempt {
            let how = AttemptEnd::Failed { class, log, limit: attempt_limit };
            match end_without_label(&mut transaction, lease.job, how, now).await? {
                JobState::Queued => FailOutcome::Requeued,
                _ => FailOutcome::Failed,
            }
        } else {
            record_failure(&mut transaction, lease.job, lease.attempt, class, log).await?;
            FailOutcome::LeaseLost
        };
        transaction.commit().await?;
        Ok(failed)
    }

    /// Releases every lease of `holder` and of its parts (`holder/part`) at an orderly stop. Does not count as
    /// failed attempts. Returns their number.
    pub async fn release_all(&self, holder: &str, now: i64) -> Result<usize> {
        self.release(holder, AttemptEnd::Lost("released"), now).await
    }

    /// Ends every lease of `process` and of its parts after a crash of that process. Each counts as a failed
    /// attempt of that class, and a job with `attempt_limit` of them fails. An attempt whose calculation is a
    /// process of its own counts only as lost: the calculation continues. Returns the number of leases.
    pub async fn fail_leases_of(
        &self,
        process: &str,
        class: &str,
        log: &str,
        attempt_limit: u32,
        now: i64,
    ) -> Result<usize> {
        self.release(process, AttemptEnd::Failed { class, log, limit: attempt_limit }, now).await
    }

    async fn release(&self, holder: &str, how: AttemptEnd<'_>, now: i64) -> Result<usize> {
        let mut transaction = self.database.begin().await?;
        let now = transaction.time(now).await?;
        let jobs: Vec<i64> = query(HELD).bind(holder).locked().fetch_all(&mut transaction).await?;
        for job in &jobs {
            let how = match how {
                AttemptEnd::Failed { .. } if has_calculation(&mut transaction, *job).await? => {
                    AttemptEnd::Lost("lost")
                }
                how => how,
            };
            end_without_label(&mut transaction, *job, how, now).await?;
        }
        transaction.commit().await?;
        Ok(jobs.len())
    }

    /// Whether every walk is over; false in a new campaign without walks.
    pub async fn all_walks_ended(&self) -> Result<bool> {
        let sql = "SELECT EXISTS (SELECT 1 FROM walk)
                   AND NOT EXISTS (SELECT 1 FROM walk WHERE state IN ('waiting', 'running'))";
        query(sql).fetch_one(&self.database).await
    }

    /// Number of jobs that are queued or leased for a first label. Labels made again do not come from walks and do
    /// not count.
    pub async fn unfinished_jobs(&self) -> Result<u64> {
        query(UNFINISHED).fetch_one(&self.database).await
    }
}

/// Whether the running attempt has started a calculation.
async fn has_calculation(transaction: &mut Transaction, job: i64) -> Result<bool> {
    let sql = "SELECT count(*) FROM attempt WHERE job = $1 AND outcome IS NULL AND calculation IS NOT NULL";
    let found: u64 = query(sql).bind(job).fetch_one(&mut *transaction).await?;
    Ok(found > 0)
}

fn lease_expiry(now: i64, seconds: u32) -> i64 {
    now.saturating_add(1000 * i64::from(seconds))
}

/// Ends expired leases whose holders cannot be at work.
async fn end_expired(transaction: &mut Transaction, now: i64, seconds: u32) -> Result<()> {
    // Another process is ending the locked ones.
    let expired = query(EXPIRED).bind(now).skip_locked();
    let expired: Vec<(i64, String)> = expired.fetch_all(&mut *transaction).await?;
    if expired.is_empty() {
        return Ok(());
    }
    let processes = processes::all(transaction).await?;
    let holds_on = |process: &&ProcessRecord| process.may_be_working(now, seconds);
    let at_work: Vec<_> = processes.iter().filter(holds_on).collect();
    for (job, holder) in expired {
        if !at_work.iter().any(|process| process.is_holder(&holder)) {
            end_without_label(transaction, job, AttemptEnd::Lost("expired"), now).await?;
        }
    }
    Ok(())
}

async fn earlier_calculations(transaction: &mut Transaction, job: i64, attempt: u32) -> Result<Vec<String>> {
    let sql = "SELECT calculation FROM attempt WHERE job = $1 AND attempt < $2 AND calculation IS NOT NULL
               AND attempt > (SELECT coalesce(max(attempt), 0) FROM attempt WHERE job = $1
                              AND outcome NOT IN ('expired', 'lost', 'released'))
               ORDER BY attempt DESC";
    query(sql).bind(job).bind(attempt).fetch_all(&mut *transaction).await
}

/// Of failed attempts, and of lost attempts with a known reason.
async fn failed_calculations(transaction: &mut Transaction, job: i64) -> Result<Vec<String>> {
    let sql =
        "SELECT calculation FROM attempt WHERE job = $1 AND class IS NOT NULL AND calculation IS NOT NULL
               AND outcome IN ('failed', 'lost') ORDER BY attempt";
    query(sql).bind(job).fetch_all(&mut *transaction).await
}

/// Of the last `failures` failed attempts, and of the attempts since then that were lost with a class, oldest
/// first.
async fn classes_of_failures(transaction: &mut Transaction, job: i64, failures: u32) -> Result<Vec<String>> {
    let sql = "SELECT class, outcome FROM attempt WHERE job = $1 AND class IS NOT NULL
               AND outcome IN ('failed', 'lost') ORDER BY attempt DESC";
    let all: Vec<(String, String)> = query(sql).bind(job).fetch_all(&mut *transaction).await?;
    let mut left = failures;
    let counted = all.into_iter().take_while(|(_, outcome)| {
        let is_earlier = outcome == "failed" && left == 0;
        left = left.saturating_sub(u32::from(outcome == "failed"));
        !is_earlier
    });
    let mut classes: Vec<String> = counted.map(|(class, _)| class).collect();
    classes.reverse();
    Ok(classes)
}

async fn structure_of(transaction: &mut Transaction, number: i64) -> Result<Structure> {
    let sql = concat!("SELECT ", joined!(structure), " FROM structure WHERE number = $1");
    let found = query(sql).bind(number).rows(&mut *transaction).await?;
    let missing = || StoreError::damaged(format!("structure {number}"), "it is not there");
    read_structure(found.first().ok_or_else(missing)?)
}

/// Name of the structure, and energy by the potential, which imported structures do not have.
async fn candidate_of(transaction: &mut Transaction, next: &NextJob) -> Result<(String, Option<f64>)> {
    let candidate = query("SELECT id, energy FROM candidate WHERE decision = $1").bind(next.decision);
    match candidate.fetch_optional(&mut *transaction).await? {
        Some(found) => Ok(found),
        None => Ok((super::structures::name(transaction, next.structure).await?, None)),
    }
}
