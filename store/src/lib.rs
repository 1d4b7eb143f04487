//! The database of a campaign: decisions, candidates, the mixture, the label queue, labels and versions of the
//! potential.
//!
//! A campaign is kept in one directory or in one schema of a server ([`Location`]). The process that runs it holds
//! the [`CampaignLock`]; any other process may open the [`Store`] at the same time. Every writing function is one
//! transaction that is on disk when the function returns, so any process may be killed at any time. No function
//! reads the wall clock: `now` is in ms since 1970, see [`unix_milliseconds`].

mod backup;
mod budget;
mod candidate_history;
mod check;
mod checksum;
mod compact;
mod database;
mod encoding;
mod error;
mod exclude;
mod export;
mod file_names;
mod filesystem;
mod history;
mod jobs;
mod label_values;
mod labelled;
mod listing;
mod location;
mod lock;
mod lower_states;
mod migrations;
mod numbers;
mod old_schema;
mod outcomes;
mod postgres;
mod process_start;
mod processes;
mod recent;
pub mod records;
mod relabel;
mod report;
mod running_labels;
mod sqlite;
mod status;
mod store;
mod tables;
mod trajectory;
mod versions;
mod walk_progress;
mod walk_trace;

use std::time::{SystemTime, UNIX_EPOCH};

pub use budget::{Budget, BudgetStatus, BudgetUse};
pub use candidate_history::{
    CoveredCandidate, ImportedStructure, LaterCoveredCandidates, SameStructure, StructureLabel,
};
pub use check::Finding;
pub use error::{Result, StoreError};
pub use exclude::{ExcludedLabel, Exclusion, ExclusionChange};
pub use export::{ExportCursor, ExportFilter, ExportRow, ExportSource, LabelMark};
pub use file_names::{DATABASE, LOCK};
pub use filesystem::{check_directory, free_space, network_file_system};
pub use history::HistorySample;
pub use jobs::{
    Attempt, CalculationArchive, CalculationRecord, CompleteOutcome, FailOutcome, ImportCounts, JobDetails,
    LabelRecord, LabelSource, LabelStatus, LeaseStatus, OldestLease, PastCalculation, QueueEntry,
    QueuedImports, Supersession,
};
pub use label_values::{FinishedStructure, LabelValue, QueuedStructure};
pub use labelled::{ArrivalSum, FailedCandidate, LabelArrival, LabelledCandidate};
pub use listing::{ListCursor, ListLimits, ListOrder, ListedCandidate, NO_LABEL_VALUE};
pub use location::{Location, ServerUrl};
pub use lock::CampaignLock;
pub use lower_states::{LowerState, LowerStateChange, LowerStateRule, OnLowerState, StateResult};
pub use numbers::NumbersError;
pub use outcomes::{
    FailureCount, LabelCost, LabelUsage, LabelledEnergies, NearDuplicate, PendingJobs, Unlabelled, ValueRange,
};
pub use postgres::server::SERVER_RECONNECT_TIMEOUT;
pub use process_start::{is_local, is_running, process_start_time};
pub use processes::{ProcessRecord, this_host};
pub use recent::{DecidedCandidate, RecentDecision};
pub use records::*;
pub use relabel::{NewProtocol, RelabelCounts, RelabelRequest, Relabellable};
pub use report::{CollectedFeatures, CollectedStructure, DecisionSample, FateCount};
pub use running_labels::RunningLabel;
pub use status::{CampaignStatus, Candidates, Declined, LabelJobCounts, WalkStatus};
pub use store::Store;
pub use versions::{VersionFiles, VersionRecord, VersionState, WalkVersions};
pub use walk_progress::{TotalThroughput, WalkProgressRecord};

/// The current time, ms since 1970.
pub fn unix_milliseconds() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_millis()).unwrap_or(i64::MAX)
}
