//! What happens in a simulation, in order of time.

use super::agent::{AgentEventKind, AgentKey};
use super::fault::Time;
use super::refit::RefitEvent;
use super::slurm::SlurmEvent;
use super::walker::WalkerKey;

/// What happens next.
#[derive(Clone, Debug)]
pub enum Event {
    Fault(usize),
    /// The end of a pause of all walks.
    Resume,
    /// A walker is killed, and again until this time.
    KillAgain(u32, Time),
    StartRun,
    /// A message arrives at the server of a run.
    ToServer {
        from: WalkerKey,
        sequence: u64,
        bytes: Vec<u8>,
    },
    /// An answer arrives at a walker.
    ToWalker {
        to: WalkerKey,
        bytes: Vec<u8>,
    },
    WalkerStarts(WalkerKey),
    WalkerPolls(WalkerKey, u64),
    WalkerFinishes(WalkerKey, u64),
    /// A run learns that a walker's process has ended.
    WalkerGone(WalkerKey, Exit),
    CommitDue(u64),
    RunTick(u64),
    RunHeartbeat(u64),
    RunSupervises(u64),
    LabellerStarts(u32),
    LabellerActs(u32, u64),
    LabellerHeartbeat(u32),
    /// A run learns that a labeller with this record has ended.
    LabellerGone(u32, String, Exit),
    CalculationEnds(String),
    Slurm(SlurmEvent),
    Agent(AgentKey, AgentEventKind),
    /// A request of an agent arrives at the run that leads.
    AgentRequest(AgentKey, u64, Vec<u8>),
    /// The heartbeat of an agent with this id is there again.
    AgentHeard(String),
    /// A run looks for silent agents.
    AgentExpiry(u64),
    Refit(RefitEvent),
    /// An agent that missed a version of the potential can be reached again.
    AgentReturns(u32),
}

/// Something that happens at a time; of two at the same time, what was planned first.
pub struct Queued {
    pub at: Time,
    pub number: u64,
    pub event: Event,
}

impl PartialEq for Queued {
    fn eq(&self, other: &Self) -> bool {
        (self.at, self.number) == (other.at, other.number)
    }
}

impl Eq for Queued {}

impl PartialOrd for Queued {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Queued {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.at, self.number).cmp(&(other.at, other.number))
    }
}

/// How a process ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// It finished.
    Done,
    /// It gave up.
    Failed,
    Killed,
    Crash,
}

impl Exit {
    pub fn reason(self) -> orchestrator::supervisor::ExitReason {
        use orchestrator::supervisor::ExitReason;
        match self {
            Self::Done => ExitReason::Exit { code: 0, last_line: None },
            Self::Failed => ExitReason::Exit { code: 1, last_line: None },
            Self::Killed => ExitReason::Signal { signal: 9, last_line: None },
            Self::Crash => ExitReason::Signal { signal: 11, last_line: None },
        }
    }
}
