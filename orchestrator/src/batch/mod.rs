//! The jobs of a campaign in a batch system: Slurm, or one that the configuration describes.
//!
//! A campaign has one job for its orchestrator, one for each agent and one for each labeller. Each job has a
//! unique [name](JobNames). In Slurm it depends on being the only job with that name (`singleton`): if two are submitted at the
//! same time, one waits for the end of the other. Slurm itself thus ensures that there is at most one orchestrator, and
//! no more agents than requested, however often jobs are launched. Jobs of a custom batch system are in a file of the campaign
//! ([`JobRecords`]), which one process at a time changes.
//!
//! A pure function, [`plan()`], decides which jobs to submit and to cancel; a [`BatchScheduler`] calls the commands.

mod custom_commands;
mod error;
mod job;
mod plan;
mod records;
mod scheduler;
mod slurm_commands;
mod stop;

pub use ::batch::{
    CustomClient, CustomError, CustomScheduler, JobId, JobPhase, JobRequest, LogTexts, SlurmError,
    StateWords, quoted,
};
pub use custom_commands::CustomCommands;
pub use error::BatchError;
pub use job::{CampaignJob, JobNames, Role};
pub use plan::{DesiredJobs, Plan, Submission, plan};
pub use records::{JobRecord, JobRecords};
pub use scheduler::BatchScheduler;
pub use slurm_commands::{JobOptions, SlurmCommands};
