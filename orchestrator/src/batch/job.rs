//! Jobs: their names and states, and the output of `squeue`.

use std::fmt;

use ::batch::{JobId, JobPhase};

/// Role of a job in a campaign.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Role {
    /// Runs the orchestrator.
    Orchestrator,
    /// Runs an agent with walkers on one node; number of the agent, from 0.
    Agent(u32),
    /// Runs labellers; number of the job, from 0.
    Labeller(u32),
}

/// Names of the jobs of one campaign.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct JobNames {
    prefix: String,
}

/// A job, as shown by `squeue`. Of a custom batch system only id, role, state and walkers are known.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CampaignJob {
    /// Job id.
    pub id: JobId,
    /// Role.
    pub role: Role,
    /// State as named by Slurm, for example `RUNNING`, whatever the batch system.
    pub state: String,
    /// Nodes; empty while it is pending.
    pub nodes: String,
    /// Start time, expected or actual: local time as 2026-11-21T20:15:00, or `N/A`.
    pub start: String,
    /// Remaining time: days-hours:minutes:seconds, or another text of Slurm.
    pub time_left: String,
    /// Number of walkers of an agent, if Slurm kept the job's comment.
    pub walkers: Option<u32>,
    /// Why it is pending or has ended, as named by Slurm; `None` without a reason.
    pub reason: Option<String>,
}

/// Precedes the number of walkers in the comment of an agent's job.
const WALKERS: &str = "walkers=";

impl Role {
    /// The serialized name, for example `orchestrator`, `agent-3`, `labeller-0`.
    pub fn name(self) -> String {
        match self {
            Self::Orchestrator => "orchestrator".to_owned(),
            Self::Agent(number) => format!("agent-{number}"),
            Self::Labeller(number) => format!("labeller-{number}"),
        }
    }

    fn from_name(name: &str) -> Option<Self> {
        let number = |text: &str| text.parse().ok();
        match name.split_once('-') {
            None => (name == "orchestrator").then_some(Self::Orchestrator),
            Some(("agent", text)) => Some(Self::Agent(number(text)?)),
            Some(("labeller", text)) => Some(Self::Labeller(number(text)?)),
            Some(_) => None,
        }
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Orchestrator => f.write_str("orchestrator"),
            Self::Agent(number) => write!(f, "agent {number}"),
            Self::Labeller(number) => write!(f, "labeller {number}"),
        }
    }
}

impl JobNames {
    /// Names for the campaign with this identifier, which consists of letters and digits.
    pub fn new(campaign: &str) -> Self {
        Self { prefix: format!("calmwalk-{campaign}-") }
    }

    /// Name of the job with this role.
    pub fn job_name(&self, role: Role) -> String {
        format!("{}{}", self.prefix, role.name())
    }

    /// Role of the job with this name, if it belongs to the campaign.
    pub fn role(&self, name: &str) -> Option<Role> {
        Role::from_name(name.strip_prefix(&self.prefix)?)
    }
}

impl CampaignJob {
    /// Format of `squeue`'s output, one line per job.
    pub(super) const FORMAT: &str = "%i|%T|%j|%N|%S|%L|%k|%r";

    /// Parses a line of `squeue`; `Ok(None)` if the job does not belong to the campaign.
    ///
    /// # Errors
    /// A job of the campaign with unexpected fields.
    pub(super) fn parse(line: &str, names: &JobNames) -> Result<Option<Self>, ()> {
        let fields: Vec<_> = line.splitn(8, '|').collect();
        let Some(role) = fields.get(2).and_then(|name| names.role(name)) else { return Ok(None) };
        let [id, state, _, nodes, start, time_left, comment, reason] = fields[..] else { return Err(()) };
        Ok(Some(Self {
            id: JobId::from(id.parse::<u64>().map_err(drop)?),
            role,
            state: state.to_owned(),
            nodes: nodes.to_owned(),
            start: start.to_owned(),
            time_left: time_left.to_owned(),
            walkers: comment.strip_prefix(WALKERS).and_then(|number| number.parse().ok()),
            reason: (reason != "None").then(|| reason.to_owned()),
        }))
    }

    /// Phase of the job.
    pub fn phase(&self) -> JobPhase {
        JobPhase::from_state(&self.state)
    }
}

/// The comment of an agent's job.
pub(super) fn comment(walkers: u32) -> String {
    format!("{WALKERS}{walkers}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_belong_to_one_campaign() {
        let names = JobNames::new("1a2b");
        for role in [Role::Orchestrator, Role::Agent(0), Role::Agent(4000), Role::Labeller(7)] {
            assert_eq!(names.role(&names.job_name(role)), Some(role));
            assert_eq!(JobNames::new("1a2").role(&names.job_name(role)), None);
            assert_eq!(JobNames::new("1a2b3").role(&names.job_name(role)), None);
        }
        for name in ["", "calmwalk-1a2b-", "calmwalk-1a2b-agent", "calmwalk-1a2b-agent-x", "agent-1"] {
            assert_eq!(names.role(name), None, "{name}");
        }
        assert_eq!(names.job_name(Role::Agent(3)), "calmwalk-1a2b-agent-3");
    }

    #[test]
    fn lines_of_squeue_are_read() {
        let names = JobNames::new("1a");
        let line = "12|RUNNING|calmwalk-1a-agent-3|node7|2026-11-21T20:15:00|1-02:00:00|walkers=16|None";
        let job = CampaignJob::parse(line, &names).unwrap().unwrap();
        assert_eq!((job.id.number(), job.role, job.phase()), (Some(12), Role::Agent(3), JobPhase::Running));
        assert_eq!((job.walkers, job.reason), (Some(16), None));
        let line = "13|PENDING|calmwalk-1a-orchestrator||N/A|2:00|(null)|launch failed | requeued held";
        let job = CampaignJob::parse(line, &names).unwrap().unwrap();
        assert_eq!((job.role, job.phase(), job.walkers), (Role::Orchestrator, JobPhase::Pending, None));
        assert_eq!(job.reason.as_deref(), Some("launch failed | requeued held"));
    }

    #[test]
    fn other_jobs_are_skipped_and_incomplete_lines_are_errors() {
        let names = JobNames::new("1a");
        for line in ["", "12|RUNNING|relax|node7|N/A|1:00|(null)|None", "12_[1-3]|PENDING|a|b"] {
            assert_eq!(CampaignJob::parse(line, &names), Ok(None), "{line}");
        }
        for line in ["12|RUNNING|calmwalk-1a-agent-3|node7", "x|RUNNING|calmwalk-1a-agent-3|n|N/A|1:00||None"]
        {
            assert_eq!(CampaignJob::parse(line, &names), Err(()), "{line}");
        }
    }
}
