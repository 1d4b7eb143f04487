//! The jobs of a campaign in the batch system Slurm.
//!
//! A campaign has one job for its orchestrator, one for each agent, one for each labeller. Each has a [name](JobNames) that
//! is used for nothing else, and depends on being the only one of that name (`singleton`): of two that were submitted at
//! the same moment one waits for the end of the other. So Slurm itself sees to it that there are never two orchestrators
//! nor more agents than asked for, whoever launches how often.
//!
//! What to do about the jobs that there are is decided by a pure function, [`plan`]; [`Slurm`] asks and tells Slurm's own
//! commands.

mod commands;
mod job;
mod plan;
mod stop;

pub use ::slurm::{Phase, SlurmError};
pub use commands::{JobOptions, Slurm};
pub use job::{Job, JobNames, Role};
pub use plan::{DesiredJobs, Plan, Submission, plan};
