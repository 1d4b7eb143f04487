//! The functions of [`crate::Store`] that access its tables, one file per topic.

mod archives;
pub mod budget;
pub mod candidate_history;
pub mod checksums;
mod commit;
mod energies;
pub mod exclude;
pub mod export;
mod imports;
pub mod job_counts;
pub mod labels;
pub mod listing;
pub mod logs;
mod near_duplicates;
pub mod outcomes;
mod pauses;
pub mod processes;
pub mod protocols;
pub mod queue;
pub mod queue_admin;
pub mod recent;
pub mod relabel;
pub mod report;
mod restore;
pub mod status;
mod walk_progress;
