//! Decides which jobs to submit and to cancel, as a function of the desired and the existing jobs.

use std::cmp::Reverse;

use ::batch::{JobId, JobPhase};

use super::job::{CampaignJob, Role};

/// The desired jobs, in addition to the orchestrator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DesiredJobs {
    /// Number of jobs with an agent.
    pub agents: u32,
    /// Number of walkers per agent.
    pub walkers: u32,
    /// Number of jobs with labellers.
    pub labellers: u32,
}

/// A job to submit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Submission {
    /// Role.
    pub role: Role,
    /// Jobs that must have ended before it starts.
    pub after_end_of: Vec<JobId>,
}

/// The jobs to cancel and to submit.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Plan {
    /// Jobs that are not desired: surplus agents, jobs that wait for another job of the same name, and agents with
    /// another number of walkers.
    pub cancel: Vec<JobId>,
    /// Missing jobs, starting with the orchestrator.
    pub submit: Vec<Submission>,
}

impl DesiredJobs {
    /// Roles of all desired jobs.
    pub fn roles(&self) -> impl Iterator<Item = Role> + use<> {
        let agents = (0..self.agents).map(Role::Agent);
        let labellers = (0..self.labellers).map(Role::Labeller);
        [Role::Orchestrator].into_iter().chain(agents).chain(labellers)
    }

    /// Whether a job has the desired number of walkers.
    fn fits(&self, job: &CampaignJob) -> bool {
        match (job.role, job.walkers) {
            // Unknown where Slurm does not keep comments.
            (Role::Agent(_), Some(walkers)) => walkers == self.walkers,
            _ => true,
        }
    }
}

/// Decides which jobs to submit and to cancel, so that each desired job exists once.
///
/// The result depends only on the arguments, so that two concurrent launches agree on which of two jobs stays.
pub fn plan(wanted: &DesiredJobs, jobs: &[CampaignJob]) -> Plan {
    let mut plan = Plan::default();
    let mut living: Vec<_> = jobs.iter().filter(|job| job.phase() != JobPhase::Over).collect();
    // Running jobs before pending ones, and then the oldest first.
    living.sort_by_key(|job| (Reverse(job.phase() == JobPhase::Running), &job.id));
    for role in wanted.roles() {
        let (of_role, others): (Vec<_>, Vec<_>) = living.into_iter().partition(|job| job.role == role);
        living = others;
        // A job that is completing may or may not be requeued: its replacement waits for its end.
        let staying: Vec<_> = of_role.iter().filter(|job| job.phase() != JobPhase::Completing).collect();
        let kept = staying.iter().find(|job| wanted.fits(job)).map(|job| &job.id);
        plan.cancel.extend(staying.iter().map(|job| &job.id).filter(|id| Some(*id) != kept).cloned());
        if kept.is_none() {
            let after_end_of = of_role.iter().map(|job| job.id.clone()).collect();
            plan.submit.push(Submission { role, after_end_of });
        }
    }
    let left = living.iter().filter(|job| job.phase() != JobPhase::Completing);
    plan.cancel.extend(left.map(|job| job.id.clone()));
    plan
}
