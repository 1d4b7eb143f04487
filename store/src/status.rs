//! A summary of the campaign's state, for display and as JSON.

use serde::Serialize;
use wire::WalkConditions;

use crate::budget::BudgetStatus;
use crate::checksum::{Names, WALK};
use crate::database::{FromRow, SqlRow};
use crate::error::Result;
use crate::jobs::OldestLease;
use crate::processes::ProcessRecord;
use crate::records::is_active_state;

/// Everything that `status` shows.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CampaignStatus {
    /// Candidates.
    pub candidates: Candidates,
    /// The label queue.
    pub labels: LabelJobCounts,
    /// The running label attempt that started first.
    pub oldest_lease: Option<OldestLease>,
    /// Labels made within the last hour.
    pub labels_last_hour: u64,
    /// Structures imported with their labels.
    pub imported: u64,
    /// Whether a process runs the campaign, as far as this host can tell.
    pub run_active: bool,
    /// Version of the mixture.
    pub mixture_version: u64,
    /// Round (reproducible mode) or 0.
    pub round: u64,
    /// Steps per second of all walks together; `None` without a report in the last minute.
    pub steps_per_second: Option<f64>,
    /// Average share of the walkers that are busy; `None` without a report in the last minute.
    pub walkers_busy: Option<f64>,
    /// Every walk, in order.
    pub walks: Vec<WalkStatus>,
    /// Processes registered for the campaign.
    pub processes: Vec<ProcessRecord>,
    /// Limits, use, and the limit that ended the campaign.
    pub budget: BudgetStatus,
    /// Every walk is over or stopped by a time limit, no label is in progress and none will be started, and no process trains
    /// a version of the potential.
    pub finished: bool,
}

/// Candidate counts.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Candidates {
    /// Candidates of biased walks that reached the selector.
    pub seen: u64,
    /// Of them, in the data set.
    pub accepted: u64,
    /// Of them, not taken.
    pub declined: Declined,
    /// Frames of control walks.
    pub control: u64,
    /// Structures rejected by the walkers' guards.
    pub rejected_by_guards: u64,
}

/// Number of declined candidates, by reason.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Declined {
    /// The newest mixture covered them.
    pub covered: u64,
    /// Known already.
    pub duplicate: u64,
    /// Atoms too close.
    pub too_close: u64,
    /// As many as there may be.
    pub budget: u64,
    /// Below the raised threshold that holds while the label queue is long.
    pub backlog: u64,
    /// Their labels would probably fail.
    pub unlikely_to_complete: u64,
    /// Their grades under the original mixture are above the bound of the guard.
    pub grade_too_large: u64,
}

/// Number of label jobs, by state.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct LabelJobCounts {
    /// Waiting.
    pub queued: u64,
    /// In work.
    pub leased: u64,
    /// Done.
    pub labelled: u64,
    /// Given up.
    pub failed: u64,
    /// Removed by hand.
    pub dropped: u64,
    /// Of an earlier protocol: a job of a later protocol replaces them.
    pub superseded: u64,
    /// Queued or leased jobs whose structure has a label, which stays until the new one arrives.
    pub relabelling: u64,
    /// Labels that could not be made again: the existing labels stay.
    pub relabel_failed: u64,
    /// Of these, labels to be made under another protocol: their jobs count as failed.
    pub failed_under_new_protocol: u64,
    /// Labels excluded from the data set by hand. Their jobs in this campaign count as labelled.
    pub excluded: u64,
    /// Structures whose label is not the lowest known state ([`crate::Store::lower_states`]).
    pub lower_states: u64,
}

/// Where a walk stands.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct WalkStatus {
    /// Its number.
    pub walk: u32,
    /// Name of its seed structure.
    pub seed_structure: String,
    /// Its conditions; `None` in campaigns of early versions.
    pub conditions: Option<WalkConditions>,
    /// `biased` or `control`.
    pub origin: String,
    /// `waiting`, `running`, or the name of its end ([`wire::messages::WalkEnd`]).
    pub state: String,
    /// Why it ended, as text.
    pub reason: String,
    /// Paused by hand: it gets no assignments until it is resumed.
    pub paused: bool,
    /// Step.
    pub step: u64,
    /// Step of its reference run, as long as that lasts and its walker reports.
    pub reference_step: Option<u64>,
    /// V₀ of a walk at constant pressure from its first step on, Å³ (Å² for a slab, Å for a wire).
    pub reference_volume: Option<f64>,
    /// Segment.
    pub segment: u32,
    /// τ.
    pub tau: Option<f64>,
    /// Kinetic temperature, K.
    pub temperature: Option<f64>,
    /// V / V₀.
    pub relative_volume: Option<f64>,
    /// Largest γ of the last graded step, under the mixture that its walker has.
    pub gamma_max: Option<f64>,
    /// Largest γ under the original mixture, at the last point of its trace.
    pub gamma_max_original: Option<f64>,
    /// Steps per second, including the time between assignments; `None` without a report in the last minute, while
    /// it is paused or while nothing runs the campaign.
    pub steps_per_second: Option<f64>,
    /// Structures accepted.
    pub accepted: u32,
    /// Structures rejected by the walker's guard.
    pub rejected: i64,
    /// Roll backs to a checkpoint.
    pub rollbacks: u32,
}

impl WalkStatus {
    /// Whether it has more steps to make.
    pub fn is_active(&self) -> bool {
        is_active_state(&self.state)
    }
}

impl FromRow for WalkStatus {
    fn from_row(row: &SqlRow) -> Result<Self> {
        WALK.verify(row, Names::Joined)?;
        Ok(Self {
            // Other tables have them.
            reference_step: None,
            reference_volume: None,
            gamma_max_original: None,
            walk: row.get("walk")?,
            seed_structure: row.get("seed_structure")?,
            conditions: None,
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
            rejected: row.get("rejected")?,
            rollbacks: row.get("rollbacks")?,
        })
    }
}
