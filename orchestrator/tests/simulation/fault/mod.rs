//! Faults: what goes wrong, and when.

mod draw;
mod story;

use super::slurm::SlurmFault;

pub use draw::plan;

/// Virtual time, ms since the start.
pub type Time = u64;

/// Links with this number and larger ones are those of agents.
pub const FIRST_AGENT: u32 = 1_000;

/// A fault of a plan.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlannedFault {
    pub at: Time,
    pub fault: Fault,
}

/// What goes wrong.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Messages between a walker and the orchestrator, in one direction.
    Link {
        walker: u32,
        direction: Direction,
        trouble: LinkTrouble,
        until: Time,
    },
    /// The next write of this client.
    NextWrite {
        client: ClientKind,
        moment: Moment,
    },
    /// No client reaches the store.
    StoreAway {
        until: Time,
    },
    /// Reads succeed, writes do not.
    StoreFull {
        until: Time,
    },
    KillWalker {
        walker: u32,
        crash: bool,
    },
    StopWalker {
        walker: u32,
        until: Time,
    },
    /// Killed again and again, while its messages are late: those of dead processes arrive.
    KillWalkerOften {
        walker: u32,
        until: Time,
    },
    KillLabeller {
        labeller: u32,
        crash: bool,
    },
    StopLabeller {
        labeller: u32,
        until: Time,
    },
    /// A second process with the same number.
    StartLabellerTwice {
        labeller: u32,
    },
    KillOrchestrator,
    /// Asked to stop in order, and started again later.
    StopInOrder,
    /// A second orchestrator is started while the first one runs.
    StartOrchestratorTwice,
    /// The orchestrator hangs; on a server its lock is lost, and another one takes over.
    Hang {
        until: Time,
    },
    /// The wall clock of the host jumps.
    ClockJump {
        milliseconds: i64,
    },
    /// A person drops a label job.
    DropJob,
    /// A person requeues a job that failed or was dropped.
    RetryJob,
    /// A person requests new labels for all labelled structures.
    Relabel,
    /// A person pauses the walks, and resumes them.
    PauseWalks {
        until: Time,
    },
    /// A calculation is killed, with everything that it would have computed.
    KillCalculation,
    /// Slurm or a node fails.
    Slurm(SlurmFault),
    /// An agent is killed, with its walkers, and started again.
    KillAgent {
        agent: u32,
    },
    /// An agent hangs; its heartbeat goes on.
    StopAgent {
        agent: u32,
        until: Time,
    },
    /// The heartbeat of an agent is missing, although the agent works.
    MuteAgent {
        agent: u32,
        until: Time,
    },
    /// Neither messages nor the heartbeat of an agent pass, in any direction.
    LoseAgent {
        agent: u32,
        until: Time,
    },
    /// An agent cannot be reached until another one has joined the walks of the next version, and some time longer.
    MissVersion {
        agent: u32,
        delay: Time,
        until: Time,
    },
    /// A walker of an agent is killed.
    KillAgentWalker {
        agent: u32,
        walker: u32,
        crash: bool,
    },
    /// The refitter that runs, or the next one, is killed after this time, and so many processes of it.
    KillRefitter {
        after: Time,
        times: u32,
        crash: bool,
    },
    /// A person goes back to an earlier version of the potential.
    RollBack,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    ToOrchestrator,
    ToWalker,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkTrouble {
    /// Every message is lost: a partition, in one direction.
    Cut,
    /// Some messages are lost.
    Loss,
    /// Messages arrive up to some seconds late, in another order.
    Delay,
    /// Messages arrive several times.
    Repetition,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClientKind {
    Orchestrator,
    Labeller,
    Refitter,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Moment {
    /// Nothing is written.
    BeforeCommit,
    /// Everything is written, and the answer is lost.
    AfterCommit,
}

impl Fault {
    /// When it is over.
    pub fn end(&self, at: Time) -> Time {
        match self {
            Self::Link { until, .. }
            | Self::StoreAway { until }
            | Self::StoreFull { until }
            | Self::StopWalker { until, .. }
            | Self::KillWalkerOften { until, .. }
            | Self::StopLabeller { until, .. }
            | Self::Hang { until }
            | Self::StopAgent { until, .. }
            | Self::MuteAgent { until, .. }
            | Self::LoseAgent { until, .. }
            | Self::MissVersion { until, .. }
            | Self::PauseWalks { until } => *until,
            Self::Slurm(fault) => fault.end(at),
            _ => at,
        }
    }
}
