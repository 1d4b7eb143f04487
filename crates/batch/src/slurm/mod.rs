//! Slurm, through its own commands.

mod client;
mod queue_full;

pub use client::{SlurmClient, SlurmError};
