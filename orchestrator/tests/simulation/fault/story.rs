//! Faults in the words of a story.

use std::fmt;

use super::{ClientKind, Direction, FIRST_AGENT, Fault, LinkTrouble, Moment, Time};

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = |time: &Time| *time as f64 / 1000.0;
        match self {
            Self::Link { walker, direction, trouble, until } => {
                let what = match trouble {
                    LinkTrouble::Cut => "no message arrives",
                    LinkTrouble::Loss => "messages are lost",
                    LinkTrouble::Delay => "messages are late",
                    LinkTrouble::Repetition => "messages are repeated",
                };
                let end = match walker.checked_sub(FIRST_AGENT) {
                    Some(agent) => format!("agent {agent}"),
                    None => format!("walker {walker}"),
                };
                let way = match direction {
                    Direction::ToOrchestrator => format!("from {end} to the orchestrator"),
                    Direction::ToWalker => format!("from the orchestrator to {end}"),
                };
                write!(f, "{what} {way}, until {} s", seconds(until))
            }
            Self::NextWrite { client, moment } => {
                let who = match client {
                    ClientKind::Orchestrator => "the orchestrator",
                    ClientKind::Labeller => "a labeller",
                    ClientKind::Refitter => "a refitter",
                };
                match moment {
                    Moment::BeforeCommit => write!(f, "the next write of {who} will fail"),
                    Moment::AfterCommit => {
                        write!(f, "the answer to the next write of {who} will be lost after its COMMIT")
                    }
                }
            }
            Self::StoreAway { until } => {
                write!(f, "the database cannot be reached until {} s", seconds(until))
            }
            Self::StoreFull { until } => write!(f, "the disk is full until {} s", seconds(until)),
            Self::KillWalker { walker, crash: false } => write!(f, "walker {walker} is killed"),
            Self::KillWalker { walker, crash: true } => write!(f, "walker {walker} crashes"),
            Self::StopWalker { walker, until } => {
                write!(f, "walker {walker} hangs until {} s", seconds(until))
            }
            Self::KillWalkerOften { walker, until } => {
                write!(
                    f,
                    "walker {walker} is killed again and again, with late messages, until {} s",
                    seconds(until)
                )
            }
            Self::KillLabeller { labeller, crash: false } => write!(f, "labeller {labeller} is killed"),
            Self::KillLabeller { labeller, crash: true } => write!(f, "labeller {labeller} crashes"),
            Self::StopLabeller { labeller, until } => {
                write!(f, "labeller {labeller} hangs until {} s", seconds(until))
            }
            Self::StartLabellerTwice { labeller } => write!(f, "labeller {labeller} is started twice"),
            Self::KillOrchestrator => f.write_str("the orchestrator is killed"),
            Self::StopInOrder => f.write_str("the run is asked to stop"),
            Self::StartOrchestratorTwice => f.write_str("a second orchestrator is started"),
            Self::Hang { until } => write!(f, "the orchestrator hangs until {} s", seconds(until)),
            Self::ClockJump { milliseconds } => {
                write!(f, "the clock jumps by {} s", *milliseconds as f64 / 1000.0)
            }
            Self::DropJob => f.write_str("a person drops a label job"),
            Self::RetryJob => f.write_str("a person requeues a label job"),
            Self::Relabel => f.write_str("a person requests new labels"),
            Self::PauseWalks { until } => {
                write!(f, "a person pauses all walks until {} s", seconds(until))
            }
            Self::KillCalculation => f.write_str("a calculation is killed"),
            Self::Slurm(fault) => fmt::Display::fmt(fault, f),
            Self::KillAgent { agent } => write!(f, "agent {agent} is killed"),
            Self::StopAgent { agent, until } => write!(f, "agent {agent} hangs until {} s", seconds(until)),
            Self::MuteAgent { agent, until } => {
                write!(f, "the heartbeat of agent {agent} is missing until {} s", seconds(until))
            }
            Self::LoseAgent { agent, until } => {
                write!(f, "agent {agent} cannot be reached until {} s", seconds(until))
            }
            Self::MissVersion { agent, delay, until } => write!(
                f,
                "agent {agent} cannot be reached until another one has joined the walks of the next version, and {} s longer, or until {} s",
                seconds(delay),
                seconds(until)
            ),
            Self::KillAgentWalker { agent, walker, .. } => {
                write!(f, "walker {walker} of agent {agent} is killed")
            }
            Self::KillRefitter { after, times, crash } => {
                let how = if *crash { "crashes" } else { "is killed" };
                write!(f, "the next refitter {how} after {} s, {times} times", seconds(after))
            }
            Self::RollBack => f.write_str("a person goes back to an earlier version"),
        }
    }
}
