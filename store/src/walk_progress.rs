//! Progress and speed of walks between checkpoints.

use serde::{Deserialize, Serialize};

use crate::database::{FromRow, SqlRow};
use crate::error::Result;

/// The last reported progress of a walk.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct WalkProgressRecord {
    /// Its number.
    pub walk: u32,
    /// When its walker last reported, ms since 1970.
    pub seen: i64,
    /// Segment.
    pub segment: u32,
    /// Step.
    pub step: u64,
    /// Step of the reference run, as long as it lasts.
    pub reference_step: Option<u64>,
    /// Steps per second, including the time between assignments; `None` until it can be computed.
    pub steps_per_second: Option<f64>,
    /// τ.
    pub tau: Option<f64>,
    /// Kinetic temperature, K.
    pub temperature: Option<f64>,
    /// V / V₀.
    pub relative_volume: Option<f64>,
    /// Largest γ of the last graded step.
    pub gamma_max: Option<f64>,
}

/// Throughput of all walks together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TotalThroughput {
    /// Steps per second; `None` until it can be computed.
    pub steps_per_second: Option<f64>,
    /// Average share of the walkers that are busy; `None` without walkers.
    pub walkers_busy: Option<f64>,
}

impl FromRow for WalkProgressRecord {
    fn from_row(row: &SqlRow) -> Result<Self> {
        Ok(Self {
            walk: row.get("walk")?,
            seen: row.get("seen")?,
            segment: row.get("segment")?,
            step: row.get("step")?,
            reference_step: row.get_or_default("reference_step")?,
            steps_per_second: row.get("steps_per_second")?,
            tau: row.get("tau")?,
            temperature: row.get("temperature")?,
            relative_volume: row.get("relative_volume")?,
            gamma_max: row.get("gamma_max")?,
        })
    }
}
