//! Progress of walks: the leader of the campaign writes it every few seconds, monitors read it.

use serde_json::{Value, json};

use super::protocols::set_campaign_value;
use crate::Store;
use crate::database::{SqlValue, Transaction, execute_rows, query};
use crate::error::Result;
use crate::walk_progress::{TotalThroughput, WalkProgressRecord};

/// Progress older than this (ms) is ignored.
const MAX_AGE: i64 = 60_000;

/// The campaign key of the total.
const TOTAL_KEY: &str = "throughput";

const COLUMNS: [&str; 10] = [
    "walk",
    "seen",
    "segment",
    "step",
    "steps_per_second",
    "tau",
    "temperature",
    "relative_volume",
    "gamma_max",
    "reference_step",
];

const UPSERT: &str = "INSERT INTO walk_progress ({columns}) SELECT * FROM {rows} WHERE TRUE
    ON CONFLICT (walk) DO UPDATE SET {excluded}";

impl Store {
    /// Stores the progress of these walks and the throughput of all together.
    pub async fn set_walk_progress(
        &self,
        walks: &[WalkProgressRecord],
        all: TotalThroughput,
        now: i64,
    ) -> Result<()> {
        let row = |walk: &WalkProgressRecord| {
            let integer = |number: i64| SqlValue::Integer(Some(number));
            let step = i64::try_from(walk.step).unwrap_or(i64::MAX);
            vec![
                integer(walk.walk.into()),
                integer(walk.seen),
                integer(walk.segment.into()),
                integer(step),
                SqlValue::Real(finite(walk.steps_per_second)),
                SqlValue::Real(finite(walk.tau)),
                SqlValue::Real(finite(walk.temperature)),
                SqlValue::Real(finite(walk.relative_volume)),
                SqlValue::Real(finite(walk.gamma_max)),
                SqlValue::Integer(walk.reference_step.map(|step| i64::try_from(step).unwrap_or(i64::MAX))),
            ]
        };
        let mut transaction = self.database.begin_as_leader().await?;
        execute_rows(&mut transaction, UPSERT, &COLUMNS, walks.iter().map(row).collect()).await?;
        let TotalThroughput { steps_per_second, walkers_busy } = all;
        let all = json!({ "time": now, "steps_per_second": steps_per_second, "walkers_busy": walkers_busy });
        let all = all.to_string();
        set_campaign_value(&mut transaction, TOTAL_KEY, &all).await?;
        transaction.commit().await
    }
}

/// SQLite has no NaN.
fn finite(number: Option<f64>) -> Option<f64> {
    number.filter(|number| number.is_finite())
}

/// Progress reported within the last minute; empty for tables of an earlier version.
pub(super) async fn recent(transaction: &mut Transaction, now: i64) -> Result<Vec<WalkProgressRecord>> {
    if !transaction.has_table("walk_progress").await? {
        return Ok(Vec::new());
    }
    query("SELECT * FROM walk_progress WHERE seen > $1 ORDER BY walk")
        .bind(now - MAX_AGE)
        .fetch_all(transaction)
        .await
}

/// Throughput of all walks together; empty without a report in the last minute.
pub(super) async fn total(transaction: &mut Transaction, now: i64) -> Result<TotalThroughput> {
    let found = query("SELECT value FROM campaign WHERE key = $1").bind(TOTAL_KEY);
    let found: Option<String> = found.fetch_optional(transaction).await?;
    let found: Value = found.and_then(|text| serde_json::from_str(&text).ok()).unwrap_or_default();
    let is_fresh = found["time"].as_i64().is_some_and(|time| time > now - MAX_AGE);
    let found = if is_fresh { serde_json::from_value(found).ok() } else { None };
    Ok(found.unwrap_or_default())
}
