//! What is simulated: the campaign, its walks and processes. A few scenarios alternate, so that a reproducible campaign
//! can be compared with its undisturbed run.

use orchestrator::selector::{CampaignMode, SelectorSettings};

use super::random::Random;
use crate::common::scripted::{Event, Script};
use crate::common::settings;

/// Number of scenarios without agents.
pub const SCENARIOS: u64 = 8;
/// Seeds from this one on have agents on other hosts.
pub const AGENT_SEEDS: u64 = 1 << 32;
/// Seeds from this one on label in Slurm jobs, and their jobs are of different difficulty.
pub const SLURM_SEEDS: u64 = 1 << 34;
/// Number of seed structures.
pub const SEED_STRUCTURES: usize = 3;

/// A campaign and its processes.
#[derive(Clone)]
pub struct Scenario {
    pub number: u64,
    pub settings: SelectorSettings,
    pub scripts: Vec<Script>,
    pub walkers: u32,
    /// Agents on other hosts, each with two walkers and an assignment in reserve.
    pub agents: u32,
    pub labellers: u32,
    /// Calculations are Slurm jobs.
    pub slurm: bool,
    /// Walkers wait while more label jobs are unfinished.
    pub queue_limit: u64,
    /// Number of labels that the campaign may make.
    pub label_budget: Option<u64>,
    /// Whether the database is a server: connections break, locks are lost, and a commit is looked up by its mark.
    pub server: bool,
}

impl Scenario {
    /// The scenario of a seed.
    pub fn of(seed: u64) -> Self {
        let slurm = seed >= SLURM_SEEDS;
        let has_agents = seed >= AGENT_SEEDS && !slurm;
        let number = seed % SCENARIOS
            + match (has_agents, slurm) {
                (true, _) => AGENT_SEEDS,
                (_, true) => SLURM_SEEDS,
                _ => 0,
            };
        let mut random = Random::new(1000 + number);
        let mode = if number.is_multiple_of(2) { CampaignMode::Reproducible } else { CampaignMode::Live };
        let settings = SelectorSettings {
            max_per_walk: 6,
            control: number % 4 < 2,
            walks_per_round: 1 + random.below(3) as usize,
            ..settings(mode)
        };
        let label_budget = (number % 4 == 3).then_some(5);
        Self {
            number,
            settings,
            scripts: (0..SEED_STRUCTURES).map(|_| script(&mut random)).collect(),
            walkers: if has_agents { 1 } else { random.between(2, 4) as u32 },
            agents: if has_agents { 2 } else { 0 },
            labellers: if slurm { 2 } else { random.between(1, 2) as u32 },
            slurm,
            // A used-up budget ends a run in earnest; here the queue stays.
            queue_limit: if label_budget.is_none() && random.happens(60) { 3 } else { 1000 },
            label_budget,
            server: number % 8 >= 4,
        }
    }

    pub fn is_reproducible(&self) -> bool {
        self.settings.mode == CampaignMode::Reproducible
    }
}

/// A walk with about one structure in four steps. Few numbers, so that some structures are found twice.
fn script(random: &mut Random) -> Script {
    let mut far = 1.5;
    let mut event = |_| match random.below(20) {
        0..14 => Event::Nothing,
        14 => Event::Return,
        15 if random.happens(30) => Event::Ungradable,
        kind => {
            let mut z = [0.0; 3];
            far *= 1.0 + random.below(40) as f64 / 100.0;
            z[random.below(3) as usize] = far;
            Event::Structure { number: random.below(12), z, close: kind == 16 }
        }
    };
    (0..24).map(&mut event).collect()
}
