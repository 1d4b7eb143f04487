//! Cores of the jobs of a campaign.

/// Cores of each kind of job.
#[derive(Clone, Copy)]
pub(super) struct CoresOfJobs {
    pub orchestrator: usize,
    pub agent: usize,
    pub labeller: usize,
}
