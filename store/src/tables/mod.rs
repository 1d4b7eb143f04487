//! What the functions of [`crate::Store`] do with its tables, a file a matter.

mod archives;
pub mod budget;
pub mod by_hand;
pub mod checksums;
pub mod collected;
mod commit;
mod energies;
pub mod exclude;
pub mod export;
pub mod history;
mod imports;
pub mod job_counts;
pub mod labels;
pub mod listing;
pub mod logs;
mod near;
pub mod outcomes;
mod pace;
mod pauses;
pub mod processes;
pub mod protocols;
pub mod queue;
pub mod recent;
pub mod relabel;
mod restore;
pub mod status;
