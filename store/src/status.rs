//! The state of a campaign at a glance, for people and as JSON.

use serde::Serialize;

use crate::budget::BudgetStatus;
use crate::checksum::{Names, WALK};
use crate::database::{FromRow, Row};
use crate::error::Result;
use crate::jobs::OldestLease;
use crate::processes::ProcessRecord;

/// Everything that `status` shows.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Status {
    /// Candidates.
    pub candidates: Candidates,
    /// The label queue.
    pub labels: Labels,
    /// The label attempt under way that began first.
    pub oldest_lease: Option<OldestLease>,
    /// Labels made within the last hour.
    pub labels_last_hour: u64,
    /// Structures that came with their labels.
    pub imported: u64,
    /// Whether a process runs the campaign, as far as can be seen from here.
    pub led: bool,
    /// Version of the mixture.
    pub mixture_version: u64,
    /// Round (reproducible mode) or 0.
    pub round: u64,
    /// Steps that all walks together make a second; none if that was not heard of within the last minute.
    pub steps_per_second: Option<f64>,
    /// Every walk, in order.
    pub walks: Vec<WalkStatus>,
    /// Processes that said that they work for the campaign.
    pub processes: Vec<ProcessRecord>,
    /// Limits, what was used of them, and which of them ended the campaign.
    pub budget: BudgetStatus,
    /// Every walk is over, or stopped by a limit of time, and no label is under way or will be begun.
    pub finished: bool,
}

/// Numbers of candidates.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Candidates {
    /// Those of biased walks that reached the selector.
    pub seen: u64,
    /// Of them, in the data set.
    pub accepted: u64,
    /// Of them, not taken.
    pub declined: Declined,
    /// Frames of control walks.
    pub control: u64,
    /// Structures that walkers' own guards refused.
    pub refused_by_walkers: u64,
}

/// Numbers of declined candidates by reason.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Declined {
    /// The newest mixture covered them.
    pub covered: u64,
    /// Known already.
    pub duplicate: u64,
    /// Atoms too close.
    pub guard: u64,
    /// As many as there may be.
    pub budget: u64,
    /// New, but not so new as it had to be while so many waited for labels.
    pub backlog: u64,
}

/// Numbers of label jobs by state.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Labels {
    /// Waiting.
    pub queued: u64,
    /// In work.
    pub leased: u64,
    /// Done.
    pub labelled: u64,
    /// Given up.
    pub failed: u64,
    /// Taken out by hand.
    pub dropped: u64,
    /// Of an earlier protocol: a job of a later one has taken their place.
    pub superseded: u64,
    /// Of those that wait or are in work: there is a label, which stays until the new one has come.
    pub again: u64,
    /// Labels that were to be made again and could not be: those that there are stay.
    pub again_in_vain: u64,
    /// Of them, those that were to be made by another protocol: their jobs count as failed.
    pub failed_again: u64,
    /// Labels that were taken out of the data set by hand; the jobs of those that were made here count as labelled.
    pub excluded: u64,
}

/// Where a walk stands.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct WalkStatus {
    /// Its number.
    pub walk: u32,
    /// Name of its seed structure.
    pub seed_structure: String,
    /// `biased` or `control`.
    pub origin: String,
    /// `waiting`, `running`, or how it ended.
    pub state: String,
    /// Why it ended, in words.
    pub reason: String,
    /// Somebody has paused it: it gets no turn until it is resumed.
    pub paused: bool,
    /// Step.
    pub step: u64,
    /// Segment.
    pub segment: u32,
    /// τ.
    pub tau: Option<f64>,
    /// Kinetic temperature, K.
    pub temperature: Option<f64>,
    /// V / V₀.
    pub relative_volume: Option<f64>,
    /// Largest γ of the last graded step.
    pub gamma_max: Option<f64>,
    /// Steps per second, with the time between its turns; none if it was not heard of within the last minute, is paused, or nobody leads the
    /// campaign.
    pub steps_per_second: Option<f64>,
    /// Structures accepted.
    pub accepted: u32,
    /// Refusals by the walker's guard.
    pub refused: i64,
    /// Returns to a checkpoint.
    pub returns: u32,
}

impl WalkStatus {
    /// Whether it has more steps to make.
    pub fn is_under_way(&self) -> bool {
        matches!(self.state.as_str(), "waiting" | "running")
    }
}

impl FromRow for WalkStatus {
    fn from_row(row: &Row) -> Result<Self> {
        WALK.verify(row, Names::Joined)?;
        Ok(Self {
            walk: row.get("walk")?,
            seed_structure: row.get("seed_structure")?,
            origin: row.get("origin")?,
            state: row.get("state")?,
            reason: row.get("reason")?,
            paused: row.get("paused")?,
            step: row.get("step")?,
            segment: row.get("segment")?,
            tau: row.get("tau")?,
            temperature: row.get("temperature")?,
            relative_volume: row.get("relative_volume")?,
            gamma_max: row.get("gamma_max")?,
            steps_per_second: row.get("steps_per_second")?,
            accepted: row.get("accepted")?,
            refused: row.get("refused")?,
            returns: row.get("returns")?,
        })
    }
}
