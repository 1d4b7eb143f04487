//! What the functions of [`crate::Store`] do with its tables, a file a matter.

mod archives;
pub mod budget;
pub mod by_hand;
mod commit;
pub mod export;
pub mod history;
mod imports;
pub mod job_counts;
pub mod labels;
pub mod logs;
mod near;
pub mod outcomes;
mod pace;
pub mod processes;
pub mod protocols;
pub mod queue;
mod restore;
pub mod status;
