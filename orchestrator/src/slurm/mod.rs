//! The jobs of a campaign in the batch system Slurm.
//!
//! A campaign has one job for its orchestrator, one for each agent and one for each labeller. Each job has a
//! unique [name](JobNames) and depends on being the only job with that name (`singleton`): if two are submitted at the
//! same time, one waits for the end of the other. Slurm itself thus ensures that there is at most one orchestrator, and
//! no more agents than requested, however often jobs are launched.
//!
//! A pure function, [`plan()`], decides which jobs to submit and to cancel; [`SlurmCommands`] calls Slurm's commands.

mod commands;
mod job;
mod plan;
mod stop;

pub use ::slurm::{JobPhase, SlurmError};
pub use commands::{JobOptions, SlurmCommands};
pub use job::{JobNames, Role, SlurmJob};
pub use plan::{DesiredJobs, Plan, Submission, plan};
