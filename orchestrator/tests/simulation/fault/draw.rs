//! Draws the faults of a seed before its simulation begins, so that a shrunk plan is a plan as well.

use super::super::random::Random;
use super::super::scenario::Scenario;
use super::super::slurm::SlurmFault;
use super::{ClientKind, Direction, FIRST_AGENT, Fault, LinkTrouble, Moment, PlannedFault, Time};

/// Faults begin before this time.
const LAST_BEGIN: Time = 70_000;
/// Longest time that a fault lasts.
const LONGEST: Time = 40_000;

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

/// A labeller that is killed while it removes a directory, in half of the seeds whose calculations are jobs.
fn killed_in_removal(seed: u64, scenario: &Scenario) -> Option<PlannedFault> {
    let mut random = Random::new(seed ^ 0x00fc_u64.rotate_left(40));
    let at = random.below(LAST_BEGIN);
    let happens = scenario.slurm && random.happens(50);
    happens.then_some(PlannedFault { at, fault: Fault::Slurm(SlurmFault::KilledInRemoval) })
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
    plan.extend(killed_in_removal(seed, scenario));
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
