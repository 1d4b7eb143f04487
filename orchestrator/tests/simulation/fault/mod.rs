//! Faults: what goes wrong, and when. A plan is drawn from the seed before the simulation begins, so that a shrunk plan
//! is a plan as well.

use std::fmt;

use super::random::Random;
use super::scenario::Scenario;
use super::slurm::SlurmFault;

/// Virtual time, ms since the start.
pub type Time = u64;

/// Faults begin before this time.
const LAST_BEGIN: Time = 70_000;
/// Links with this number and larger ones are those of agents.
pub const FIRST_AGENT: u32 = 1_000;
/// Longest time that a fault lasts.
const LONGEST: Time = 40_000;

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
    /// A fault of agents and their links.
    fn draw_of_agents(random: &mut Random, scenario: &Scenario, at: Time) -> Self {
        let agent = random.below(scenario.agents.into()) as u32;
        let until = at + random.between(2_000, LONGEST);
        match random.below(10) {
            0..5 => {
                let direction = [Direction::ToOrchestrator, Direction::ToWalker][random.below(2) as usize];
                let troubles =
                    [LinkTrouble::Cut, LinkTrouble::Loss, LinkTrouble::Delay, LinkTrouble::Repetition];
                let trouble = troubles[random.below(4) as usize];
                Self::Link { walker: FIRST_AGENT + agent, direction, trouble, until }
            }
            5..7 => Self::KillAgent { agent },
            7 => Self::StopAgent { agent, until },
            8 => Self::MuteAgent { agent, until },
            _ => Self::KillAgentWalker { agent, walker: random.below(2) as u32, crash: random.happens(20) },
        }
    }

    /// A fault of refits.
    fn draw_of_refits(random: &mut Random, scenario: &Scenario, at: Time) -> Self {
        match random.below(10) {
            0..4 => {
                let moment = [Moment::BeforeCommit, Moment::AfterCommit][random.below(2) as usize];
                Self::NextWrite { client: ClientKind::Refitter, moment }
            }
            4..6 => Self::KillOrchestrator,
            6 if !scenario.is_reproducible() => Self::RollBack,
            7..9 if scenario.agents > 0 => {
                let agent = random.below(scenario.agents.into()) as u32;
                Self::LoseAgent { agent, until: at + random.between(20_000, 60_000) }
            }
            _ => Self::kill_refitter(random),
        }
    }

    fn kill_refitter(random: &mut Random) -> Self {
        let (after, times) = (random.below(15_000), random.between(1, 3) as u32);
        Self::KillRefitter { after, times, crash: random.happens(50) }
    }

    fn draw(random: &mut Random, scenario: &Scenario, at: Time) -> Self {
        let walker = random.below(scenario.walkers.into()) as u32;
        let labeller = random.below(scenario.labellers.into()) as u32;
        let until = at + random.between(2_000, LONGEST);
        let crash = random.happens(30);
        match random.below(23) {
            0..4 => {
                let direction = [Direction::ToOrchestrator, Direction::ToWalker][random.below(2) as usize];
                let troubles =
                    [LinkTrouble::Cut, LinkTrouble::Loss, LinkTrouble::Delay, LinkTrouble::Repetition];
                Self::Link { walker, direction, trouble: troubles[random.below(4) as usize], until }
            }
            4..8 => {
                let client = [ClientKind::Orchestrator, ClientKind::Labeller][random.below(2) as usize];
                let moment = [Moment::BeforeCommit, Moment::AfterCommit][random.below(2) as usize];
                Self::NextWrite { client, moment }
            }
            8 => Self::StoreAway { until },
            9 => Self::StoreFull { until },
            10 => Self::KillWalker { walker, crash },
            11 => Self::StopWalker { walker, until: until + LONGEST },
            12 => Self::KillLabeller { labeller, crash },
            13 => Self::StopLabeller { labeller, until: until + LONGEST },
            14 => Self::StartLabellerTwice { labeller },
            15 => Self::KillOrchestrator,
            16 => Self::StopInOrder,
            17 => Self::StartOrchestratorTwice,
            18 => Self::Hang { until },
            19 if random.happens(50) => {
                Self::ClockJump { milliseconds: random.between(0, 7_200_000).cast_signed() - 3_600_000 }
            }
            19 => Self::KillCalculation,
            22 => Self::KillWalkerOften { walker, until: at + 11_000 },
            20 if random.happens(50) => Self::DropJob,
            20 if random.happens(50) => Self::RetryJob,
            20 => Self::Relabel,
            _ => Self::PauseWalks { until },
        }
    }

    /// Replaces what would change the labels of a campaign.
    fn keep_labels(&mut self, random: &mut Random) {
        match self {
            Self::DropJob | Self::RetryJob | Self::Relabel => *self = Self::kill_refitter(random),
            Self::KillLabeller { crash, .. } => *crash = false,
            _ => {}
        }
    }

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

/// An agent that is out of reach exactly while a version is taken up, in half of the seeds that have both.
fn missed_version(seed: u64, scenario: &Scenario) -> Option<PlannedFault> {
    // Numbers of their own: the other faults of a seed are what they would be without it.
    let mut random = Random::new(seed ^ 0x00fb_u64.rotate_left(40));
    if scenario.refits.is_none() || scenario.agents == 0 || random.happens(50) {
        return None;
    }
    let at = random.between(2_000, 30_000);
    let agent = random.below(scenario.agents.into()) as u32;
    let (delay, until) = (random.below(20_000), at + 3 * LONGEST);
    Some(PlannedFault { at, fault: Fault::MissVersion { agent, delay, until } })
}

/// The plan of a seed, in order of time.
pub fn plan(seed: u64, scenario: &Scenario) -> Vec<PlannedFault> {
    let mut random = Random::new(seed ^ 0x00fa_u64.rotate_left(40));
    let number = random.between(2, 9);
    let mut plan: Vec<PlannedFault> = (0..number)
        .map(|_| {
            let at = random.below(LAST_BEGIN);
            let share_of_agents = if scenario.refits.is_some() { 30 } else { 60 };
            let of_agents = scenario.agents > 0 && random.happens(share_of_agents);
            let of_refits = scenario.refits.is_some() && random.happens(50);
            if scenario.slurm && random.happens(60) {
                let until = at + random.between(2_000, LONGEST);
                return PlannedFault { at, fault: Fault::Slurm(SlurmFault::draw(&mut random, until)) };
            }
            let draw = match (of_agents, of_refits) {
                (true, _) => Fault::draw_of_agents,
                (_, true) => Fault::draw_of_refits,
                _ => Fault::draw,
            };
            PlannedFault { at, fault: draw(&mut random, scenario, at) }
        })
        .collect();
    if scenario.has_fixed_labels() {
        plan.iter_mut().for_each(|planned| planned.fault.keep_labels(&mut random));
    }
    plan.extend(missed_version(seed, scenario));
    plan.sort_by_key(|planned| planned.at);
    // A third crash in the same assignment would end its walk, and a reproducible campaign would differ.
    let mut crashes = 0;
    for PlannedFault { fault, .. } in &mut plan {
        if let Fault::KillWalker { crash, .. } | Fault::KillAgentWalker { crash, .. } = fault {
            crashes += u32::from(*crash);
            *crash &= crashes <= 2;
        }
    }
    plan
}

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
