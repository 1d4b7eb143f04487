//! The batch system Slurm, by its own commands.
//!
//! What does not answer has said nothing: an error here is never a word about a job.

mod client;
mod job_phase;

pub use client::{SlurmClient, SlurmError};
pub use job_phase::JobPhase;
