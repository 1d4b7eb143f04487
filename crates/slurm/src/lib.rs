//! The batch system Slurm, by its own commands.
//!
//! What does not answer has said nothing: an error here is never a word about a job.

mod commands;
mod phase;

pub use commands::{Commands, SlurmError};
pub use phase::Phase;
