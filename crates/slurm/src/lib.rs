//! Access to the batch system Slurm through its commands.
//!
//! A command that fails or times out carries no information about a job: an error never means that a job has
//! ended.

mod client;
mod job_phase;
mod queue_full;

pub use client::{SlurmClient, SlurmError};
pub use job_phase::JobPhase;
