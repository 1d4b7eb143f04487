//! The database of a campaign: what was decided, what is queued, what was labelled.
//!
//! One directory holds one campaign, or one schema of a server ([`Location`]). Whoever runs it holds the [`CampaignLock`]; anyone may open the [`Store`] beside
//! it. Every writing function is one transaction that is on the disk when the function returns, so any process
//! may be killed at any time. No function reads a clock: `now` is ms since 1970, see [`unix_milliseconds`].

mod backup;
mod birth;
mod budget;
mod check;
mod checksum;
mod collected;
mod compact;
mod database;
mod encoding;
mod error;
mod exclude;
mod export;
mod filesystem;
mod history;
mod jobs;
mod listing;
mod location;
mod lock;
mod migrations;
mod numbers;
mod outcomes;
mod pace;
mod postgres;
mod processes;
mod recent;
pub mod records;
mod relabel;
mod sqlite;
mod status;
mod store;
mod tables;

use std::time::{SystemTime, UNIX_EPOCH};

pub use birth::{is_local, is_running, process_birth};
pub use budget::{Budget, BudgetStatus, BudgetUse};
pub use check::Finding;
pub use collected::{Collected, FateCount};
pub use error::{Result, StoreError};
pub use exclude::{ExcludedLabel, Exclusion, ExclusionChange};
pub use export::{ExportFilter, ExportPlace, ExportRow, ExportSource};
pub use filesystem::{check_directory, free_space, network_file_system};
pub use history::{Covered, ImportedStructure, LaterCovered, Named, SameStructure, StructureLabel};
pub use jobs::{
    Archive, Attempt, CalculationRecord, Completed, Failed, Imported, Job, JobDetails, LabelRecord,
    LabelSource, OldestLease, PastCalculation, Standing, Superseded, Whereabouts,
};
pub use listing::{ListOrder, ListPlace, ListedCandidate};
pub use location::{Location, ServerUrl};
pub use lock::{CampaignLock, LOCK};
pub use numbers::NumbersError;
pub use outcomes::{
    FailureCount, Finished, LabelCost, LabelledEnergies, NearLabel, Range, Unlabelled, Waiting, Work,
};
pub use pace::Pace;
pub use processes::{ProcessRecord, this_host};
pub use recent::{DecidedCandidate, RecentDecision};
pub use records::*;
pub use relabel::{NewProtocol, Relabel, Relabellable, Requeued};
pub use sqlite::DATABASE;
pub use status::{Candidates, Declined, Labels, Status, WalkStatus};
pub use store::{SERVER_AWAY, Store};

/// The time now, ms since 1970.
pub fn unix_milliseconds() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_millis()).unwrap_or(i64::MAX)
}
