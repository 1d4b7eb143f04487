//! What is simulated: the campaign, its walks and processes. A few scenarios alternate, so that a reproducible campaign
//! can be compared with its undisturbed run.

use monitor::refit_progress::RefitRules;
use monitor::refit_schedule::RefitTiming;
use orchestrator::selector::{CampaignMode, SelectorSettings};
use serde_json::{Value, json};

use super::random::Random;
use crate::common::scripted::{Event, Script};
use crate::common::settings;

/// Number of scenarios without agents.
pub const SCENARIOS: u64 = 8;
/// Seeds from this one on have agents on other hosts.
pub const AGENT_SEEDS: u64 = 1 << 32;
/// Seeds from this one on have refits of the potential.
pub const REFIT_SEEDS: u64 = 1 << 33;
/// Seeds from this one on label in Slurm jobs, and their jobs are of different difficulty.
pub const SLURM_SEEDS: u64 = 1 << 34;
/// Seeds from this one on have PBS or LSF in place of Slurm.
pub const CUSTOM_SEEDS: u64 = 1 << 35;
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
    /// Calculations are jobs of a batch system, …
    pub slurm: bool,
    /// … which is PBS or LSF.
    pub custom: bool,
    /// Walkers wait while more label jobs are unfinished.
    pub queue_limit: u64,
    /// Number of labels that the campaign may make.
    pub label_budget: Option<u64>,
    /// Whether the database is a server: connections break, locks are lost, and a commit is looked up by its mark.
    pub server: bool,
    /// How the potential is trained anew, if it is.
    pub refits: Option<RefitPlan>,
}

/// How the potential is trained anew.
#[derive(Clone)]
pub struct RefitPlan {
    /// The configuration in force, of which labellers read the rules as well.
    pub configuration: Value,
    pub timing: RefitTiming,
    /// Number of processes that a refit may crash.
    pub max_attempts: u32,
}

impl RefitPlan {
    fn of(number: u64, mode: CampaignMode) -> Self {
        let mut random = Random::new(3000 + number);
        let beside_walks = mode == CampaignMode::Live;
        let timing = RefitTiming {
            beside_walks,
            after_structures: random.happens(75).then(|| random.between(2, 4) as u32),
            after_time: (beside_walks && random.happens(60)).then_some(25_000),
        };
        let refit = json!({ "max_versions": random.between(1, 3) });
        // An eighth of the campaigns end because a version improves too little.
        let stop = json!({ "min_improvement": (number % 8 == 6).then_some(1.5) });
        Self { configuration: json!({ "refit": refit, "stop": stop }), timing, max_attempts: 2 }
    }

    pub fn rules(&self) -> RefitRules {
        RefitRules::from_json(&self.configuration)
    }
}

impl Scenario {
    /// The scenario of a seed.
    pub fn of(seed: u64) -> Self {
        let (has_refits, slurm) = ((REFIT_SEEDS..SLURM_SEEDS).contains(&seed), seed >= SLURM_SEEDS);
        let first = [0, AGENT_SEEDS, REFIT_SEEDS, SLURM_SEEDS, CUSTOM_SEEDS]
            .into_iter()
            .rfind(|first| seed >= *first)
            .unwrap();
        let number = seed % SCENARIOS + first;
        // With refits, a file and a server have agents, in live and in reproducible mode.
        let has_agents = match has_refits {
            true => [3, 4].contains(&(seed % SCENARIOS)),
            false => seed >= AGENT_SEEDS && !slurm,
        };
        let mut random = Random::new(1000 + number);
        let mode = if number.is_multiple_of(2) { CampaignMode::Reproducible } else { CampaignMode::Live };
        let settings = SelectorSettings {
            max_per_walk: 6,
            control: number % 4 < 2,
            walks_per_round: 1 + random.below(3) as usize,
            ..settings(mode)
        };
        let label_budget = (number % 4 == 3 && !has_refits).then_some(5);
        Self {
            number,
            settings,
            scripts: (0..SEED_STRUCTURES).map(|_| script(&mut random)).collect(),
            walkers: if has_agents { 1 } else { random.between(2, 4) as u32 },
            agents: if has_agents { 2 } else { 0 },
            labellers: if slurm { 2 } else { random.between(1, 2) as u32 },
            slurm,
            custom: seed >= CUSTOM_SEEDS,
            // A used-up budget ends a run in earnest; here the queue stays.
            queue_limit: if label_budget.is_none() && random.happens(60) { 3 } else { 1000 },
            label_budget,
            server: number % 8 >= 4,
            refits: has_refits.then(|| RefitPlan::of(number, mode)),
        }
    }

    /// What happens in the walks from a seed structure with a version of the potential.
    pub fn script(&self, seed_structure: usize, version: u32) -> Script {
        if version == 0 {
            return self.scripts[seed_structure].clone();
        }
        let place = 100 * u64::from(version) + seed_structure as u64;
        let mut events = script(&mut Random::new(self.number ^ place << 16));
        for event in &mut events {
            if let Event::Structure { number, .. } = event {
                // Some of them are known from the versions before.
                *number += 8 * u64::from(version);
            }
        }
        events
    }

    /// Whether versions and decision log must be those of the undisturbed run, so that labels may not depend on faults.
    pub fn has_fixed_labels(&self) -> bool {
        self.refits.is_some() && self.is_reproducible()
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
