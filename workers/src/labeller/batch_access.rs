//! Access to batch systems for calculations.

use super::ExecutionSettings;
use super::custom_jobs::CustomJobs;
use super::slurm::Slurm;

/// The batch systems in which calculations may be.
pub(super) struct BatchAccess {
    pub slurm: Slurm,
    /// The one that the configuration describes.
    pub custom: Option<CustomJobs>,
}

impl BatchAccess {
    pub fn new(execution: &ExecutionSettings) -> Self {
        let custom = execution.scheduler.clone();
        let custom = custom.map(|scheduler| CustomJobs::new(*scheduler, &execution.pass_environment));
        Self { slurm: Slurm::new(&execution.pass_environment), custom }
    }
}
