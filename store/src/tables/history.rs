//! The history of a campaign: the leader adds a sample every few seconds and thins out those that have aged.

use super::{budget, job_counts, status, walk_progress};
use crate::Store;
use crate::database::{SqlValue, Transaction, execute_rows, query};
use crate::error::Result;
use crate::history::HistorySample;
use crate::unix_milliseconds;

const TABLE: &str = "sample";
const COLUMNS: [&str; 13] = [
    "time",
    "run",
    "seen",
    "accepted",
    "queued",
    "leased",
    "labels",
    "failed_attempts",
    "failed_jobs",
    "core_milliseconds",
    "mixture_version",
    "steps_per_second",
    "walkers_busy",
];

const UPSERT: &str = "INSERT INTO sample ({columns}) SELECT * FROM {rows} WHERE TRUE
    ON CONFLICT (time) DO UPDATE SET {excluded}";

const SEEN: &str =
    "SELECT CAST(coalesce(sum(number), 0) AS BIGINT) FROM candidate_count WHERE origin = 'biased'";
const FAILED_ATTEMPTS: &str = "SELECT count(*) FROM attempt WHERE class IS NOT NULL";
const MIXTURE: &str = "SELECT mixture_version FROM decision ORDER BY sequence DESC LIMIT 1";

/// Keeps the first sample of each run in each interval of $2 ms before $1.
const THIN: &str = "DELETE FROM sample WHERE time < $1 AND time NOT IN
    (SELECT min(time) FROM sample WHERE time < $1 GROUP BY run, time / $2)";

const MINUTE: i64 = 60_000;
const HOUR: i64 = 60 * MINUTE;
const DAY: i64 = 24 * HOUR;
/// The interval at which samples of this age are kept, ms: a month has about 3000.
const KEPT: [(i64, i64); 4] =
    [(10 * MINUTE, 15_000), (2 * HOUR, 2 * MINUTE), (2 * DAY, 30 * MINUTE), (60 * DAY, 6 * HOUR)];

impl Store {
    /// Adds a sample of the present state at the time `now`. `run`: when the run began.
    pub async fn add_history_sample(&self, run: i64, now: i64) -> Result<()> {
        let mut transaction = self.database.begin_as_leader().await?;
        let row = sample(&mut transaction, run, now).await?;
        execute_rows(&mut transaction, UPSERT, &COLUMNS, vec![row]).await?;
        transaction.commit().await
    }

    /// Thins out the samples that have aged by the time `now`.
    pub async fn thin_history(&self, now: i64) -> Result<()> {
        let mut transaction = self.database.begin_as_leader().await?;
        for (age, interval) in KEPT {
            query(THIN).bind(now - age).bind(interval).execute(&mut transaction).await?;
        }
        transaction.commit().await
    }

    /// All samples, oldest first. Empty for tables of an earlier version.
    pub async fn history(&self) -> Result<Vec<HistorySample>> {
        let mut transaction = self.database.begin_read().await?;
        let samples = match transaction.has_table(TABLE).await? {
            true => query("SELECT * FROM sample ORDER BY time").fetch_all(&mut transaction).await?,
            false => Vec::new(),
        };
        transaction.commit().await?;
        Ok(samples)
    }
}

async fn sample(transaction: &mut Transaction, run: i64, now: i64) -> Result<Vec<SqlValue>> {
    let (_, used) = budget::read(transaction, now).await?;
    let states = job_counts::states(transaction).await?;
    let jobs = |state: &str| states.iter().find(|(name, _)| name == state).map_or(0, |(_, number)| *number);
    let mixture: Option<u64> = query(MIXTURE).fetch_optional(&mut *transaction).await?;
    let seen: u64 = query(SEEN).fetch_one(&mut *transaction).await?;
    let accepted: u64 = query(status::ACCEPTED).fetch_one(&mut *transaction).await?;
    let failed: u64 = query(FAILED_ATTEMPTS).fetch_one(&mut *transaction).await?;
    let speed = walk_progress::total(transaction, unix_milliseconds()).await?;
    let whole = |number: u64| SqlValue::Integer(Some(i64::try_from(number).unwrap_or(i64::MAX)));
    Ok(vec![
        SqlValue::Integer(Some(now)),
        SqlValue::Integer(Some(run)),
        whole(seen),
        whole(accepted),
        whole(jobs("queued")),
        whole(jobs("leased")),
        whole(used.labels),
        whole(failed),
        whole(jobs("failed")),
        SqlValue::Integer(Some((used.core_hours * 3.6e6).round() as i64)),
        whole(mixture.unwrap_or(0)),
        SqlValue::Real(speed.steps_per_second.filter(|speed| speed.is_finite())),
        SqlValue::Real(speed.walkers_busy.filter(|share| share.is_finite())),
    ])
}
