//! Samples of the state of a campaign over time.

use serde::Serialize;

use crate::database::{FromRow, SqlRow};
use crate::error::Result;

/// The state of a campaign at one time.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct HistorySample {
    /// ms since 1970.
    pub time: i64,
    /// When the run that recorded it began, ms since 1970. Between samples of two runs nothing ran.
    pub run: i64,
    /// Candidates of biased walks so far.
    pub seen: u64,
    /// Of these, accepted.
    pub accepted: u64,
    /// Jobs that wait.
    pub queued: u64,
    /// Jobs under way.
    pub leased: u64,
    /// Labels made so far.
    pub labels: u64,
    /// Attempts at labels that failed so far.
    pub failed_attempts: u64,
    /// Jobs that have failed for good.
    pub failed_jobs: u64,
    /// Cost of all attempts so far, core-hours.
    pub core_hours: f64,
    /// Version of the mixture.
    pub mixture_version: u64,
    /// Steps of all walks per second; `None` while none reports.
    pub steps_per_second: Option<f64>,
    /// Average share of the walkers that are busy.
    pub walkers_busy: Option<f64>,
}

impl FromRow for HistorySample {
    fn from_row(row: &SqlRow) -> Result<Self> {
        Ok(Self {
            time: row.get("time")?,
            run: row.get("run")?,
            seen: row.get("seen")?,
            accepted: row.get("accepted")?,
            queued: row.get("queued")?,
            leased: row.get("leased")?,
            labels: row.get("labels")?,
            failed_attempts: row.get("failed_attempts")?,
            failed_jobs: row.get("failed_jobs")?,
            core_hours: row.get::<i64>("core_milliseconds")? as f64 / 3.6e6,
            mixture_version: row.get("mixture_version")?,
            steps_per_second: row.get("steps_per_second")?,
            walkers_busy: row.get("walkers_busy")?,
        })
    }
}
