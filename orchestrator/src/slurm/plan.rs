//! What is to be submitted and cancelled: a function of what is asked for and what there is.

use std::cmp::Reverse;

use ::slurm::Phase;

use super::job::{Job, Role};

/// What is asked for, beside an orchestrator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DesiredJobs {
    /// Jobs with an agent.
    pub agents: u32,
    /// Walkers of each.
    pub walkers: u32,
    /// Jobs with labellers.
    pub labellers: u32,
}

/// A job to submit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Submission {
    /// What it does.
    pub role: Role,
    /// Jobs that must have ended before it begins.
    pub after_end_of: Vec<u64>,
}

/// What is to be done.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Plan {
    /// Jobs that are not wanted: of agents that are too many, those that wait behind another of the same name, agents
    /// with another number of walkers.
    pub cancel: Vec<u64>,
    /// Jobs that are missing; the orchestrator first.
    pub submit: Vec<Submission>,
}

impl DesiredJobs {
    /// Every job that there is to be.
    pub fn roles(&self) -> impl Iterator<Item = Role> + use<> {
        let agents = (0..self.agents).map(Role::Agent);
        let labellers = (0..self.labellers).map(Role::Labeller);
        [Role::Orchestrator].into_iter().chain(agents).chain(labellers)
    }

    /// Whether a job is what it would be submitted as.
    fn fits(&self, job: &Job) -> bool {
        match (job.role, job.walkers) {
            // Where comments are not kept nobody knows.
            (Role::Agent(_), Some(walkers)) => walkers == self.walkers,
            _ => true,
        }
    }
}

/// What is to be done so that the jobs that live are those that are wanted, each once.
///
/// The same is decided for the same jobs, so that two who launch at the same moment agree about which of two jobs is to stay.
pub fn plan(wanted: &DesiredJobs, jobs: &[Job]) -> Plan {
    let mut plan = Plan::default();
    let mut living: Vec<_> = jobs.iter().filter(|job| job.phase() != Phase::Over).collect();
    // Those that run before those that wait, and of these the first.
    living.sort_by_key(|job| (Reverse(job.phase() == Phase::Running), job.id));
    for role in wanted.roles() {
        let (of_role, others): (Vec<_>, Vec<_>) = living.into_iter().partition(|job| job.role == role);
        living = others;
        // One that ends may come back, or may not: in its place another waits for its end.
        let staying: Vec<_> = of_role.iter().filter(|job| job.phase() != Phase::Completing).collect();
        let kept = staying.iter().find(|job| wanted.fits(job)).map(|job| job.id);
        plan.cancel.extend(staying.iter().map(|job| job.id).filter(|id| Some(*id) != kept));
        if kept.is_none() {
            let after_end_of = of_role.iter().map(|job| job.id).collect();
            plan.submit.push(Submission { role, after_end_of });
        }
    }
    let left = living.iter().filter(|job| job.phase() != Phase::Completing);
    plan.cancel.extend(left.map(|job| job.id));
    plan
}
