//! Access to batch systems through their commands: to Slurm through its own ([`SlurmClient`]), to any other through the
//! commands that a configuration describes ([`CustomScheduler`]).
//!
//! A command that fails or times out carries no information about a job: an error never means that a job has
//! ended.

mod custom;
mod full_pause;
mod job_id;
mod job_phase;
mod quoted;
mod slurm;

pub use custom::{
    CommandOutput, CustomClient, CustomError, CustomScheduler, JobRequest, LogTexts, PolledState, StateWords,
};
pub use job_id::JobId;
pub use job_phase::JobPhase;
pub use quoted::quoted;
pub use slurm::{SlurmClient, SlurmError};
