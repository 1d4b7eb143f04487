//! The time that walks spend waiting for each other: the walks of the aluminium campaign of `configs/`, one
//! walker each, in live mode and in rounds. Dynamics and decisions are real and run one after another on this
//! machine; a simulated clock that advances by the processor time of each assignment gives the time they would
//! take in parallel.
//!
//! `cargo bench --bench rounds`; a number after `--` sets the steps per assignment. The results are in
//! `docs/benchmarks.md`.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use atoms::MinDistanceRule;
use calm::forgetting::ForgettingAlarm;
use calm::{Artifact, UpdateSettings};
use md::{LangevinSettings, ThermostatSettings};
use orchestrator::grader::Grader;
use orchestrator::selector::{
    Mode, OnForgetting, Scheduling, SeedStructure, Selector, SelectorSnapshot, Settings, UpdateProtocol,
};
use potentials::grace::{GraceModel, Threads};
use potentials::{ZblWindow, ZblWindows};
use rustix::time::{ClockId, clock_gettime};
use wire::messages::{Outcome, Report};
use wire::{CampaignId, CandidateBlock, WalkConditions};
use workers::settings::{GuardSettings, WalkSettings};
use workers::walk::{WalkContext, advance};

/// Default steps per assignment, as in `configs/`.
const STEPS_PER_ASSIGNMENT: u64 = 250;

fn main() {
    let assignment_steps =
        std::env::args().skip(1).find_map(|text| text.parse().ok()).unwrap_or(STEPS_PER_ASSIGNMENT);
    println!("assignments of {assignment_steps} steps");
    println!("{:<16} {:>10} {:>10} {:>12} {:>14}", "", "candidates", "accepted", "seconds", "walkers busy");
    let [live, rounds] = [Mode::Live, Mode::Reproducible].map(|mode| Campaign::run(mode, assignment_steps));
    let rate = |campaign: &Campaign| f64::from(campaign.candidates) / campaign.time.as_secs_f64();
    println!("candidates an hour, live over rounds: {:.2}", rate(&live) / rate(&rounds));
}

/// Result of a campaign.
#[derive(Default)]
struct Campaign {
    candidates: u32,
    accepted: u32,
    /// Time on the simulated clock of parallel walkers.
    time: Duration,
    /// Total processor time of all walkers.
    work: Duration,
}

/// A running assignment: when it ends, the order of start for ties, and its report.
struct RunningAssignment(Duration, u64, Report);

impl Campaign {
    fn run(mode: Mode, assignment_steps: u64) -> Self {
        let model = Arc::new(GraceModel::load(&data("al_eam_1l/kokkos.npz")).unwrap());
        let context = WalkContext {
            model: Arc::clone(&model),
            threads: Threads::default(),
            settings: Arc::new(walk_settings()),
        };
        let mut selector = selector(mode, assignment_steps, &model);
        selector.start_walks();
        let (mut campaign, mut running, mut begun) = (Self::default(), BinaryHeap::new(), 0);
        loop {
            // There are as many walkers as walks, so every assignment starts at once.
            while let Scheduling::Assign(assignment) = selector.next_assignment(0) {
                let used = processor_time();
                let report = advance(&context, &assignment, Arc::clone(selector.mixture()), || false, |_| {});
                let taken = processor_time() - used;
                campaign.work += taken;
                begun += 1;
                let report = report.map_candidate(|candidate| CandidateBlock::encode(&candidate));
                running.push(Reverse(RunningAssignment(campaign.time + taken, begun, report)));
            }
            let Some(Reverse(RunningAssignment(ended, _, report))) = running.pop() else { break };
            campaign.time = ended;
            campaign.candidates += u32::from(matches!(report.outcome, Outcome::Candidate(_)));
            let commit = selector.report(report).unwrap().unwrap_or_default();
            let accepted = commit.decisions.iter().filter(|decision| decision.kind == "accepted");
            campaign.accepted += accepted.count() as u32;
        }
        let busy = campaign.work.as_secs_f64() / (seeds().len() as f64 * campaign.time.as_secs_f64());
        println!(
            "{:<16} {:>10} {:>10} {:>12.1} {:>12.0} %",
            mode.name(),
            campaign.candidates,
            campaign.accepted,
            campaign.time.as_secs_f64(),
            100.0 * busy
        );
        campaign
    }
}

/// Processor time of this thread, which other load on the machine does not affect.
fn processor_time() -> Duration {
    Duration::try_from(clock_gettime(ClockId::ThreadCPUTime)).unwrap()
}

fn selector(mode: Mode, assignment_steps: u64, model: &GraceModel) -> Selector {
    let rule = "rule = 'atom_count'\nthreshold = 1.3\nfraction = 0.15\nmin_atoms = 3\n";
    let settings = Settings {
        mode,
        walks_per_round: seeds().len(),
        steps_per_assignment: assignment_steps,
        update: UpdateProtocol::Cumulative,
        search: UpdateSettings {
            covariance_update: calm::CovarianceUpdateKind::Convex,
            alpha_values: None,
            stop: toml::from_str(&format!("{rule}target = 1.25")).unwrap(),
        },
        forgetting_alarm: ForgettingAlarm::default(),
        on_forgetting: OnForgetting::default(),
        collection: toml::from_str(rule).unwrap(),
        max_per_walk: u32::MAX,
        max_per_seed_structure: None,
        max_structures: None,
        control: false,
        control_share: 0.5,
        min_distances: MinDistanceRule::default(),
        declined_feature_bytes: 0,
    };
    let n = model.elements().len();
    let cutoffs = (0..n * n).map(|k| model.pair_cutoff(k / n, k % n)).collect();
    let grader = Grader::new(model.elements().to_vec(), cutoffs);
    let original = Arc::new(Artifact::load(data("al_eam_1l/gmm_artifacts.npz")).unwrap().mixture);
    let (campaign, snapshot) = (CampaignId([1; 16]), SelectorSnapshot::default());
    Selector::restore(settings, campaign, seeds(), grader, original, None, snapshot).unwrap()
}

fn walk_settings() -> WalkSettings {
    WalkSettings {
        rng_seed: 1,
        thermostat: ThermostatSettings::Langevin(LangevinSettings { friction: 0.01 }),
        time_step: None,
        equilibration: 500,
        steps: 2000,
        bias_averaging_steps: 10,
        skin: 0.5,
        collection: toml::from_str("rule = 'atom_count'\nthreshold = 1.3\nfraction = 0.15\nmin_atoms = 3")
            .unwrap(),
        gap: 200,
        min_interval_after_decline: 20,
        zbl: Some(ZblWindows::Uniform(ZblWindow { inner: 1.6, outer: 2.4 })),
        guard: GuardSettings {
            min_distances: MinDistanceRule::default(),
            max_temperature: 20_000.0,
            rollback: true,
            max_consecutive_rejections: 10,
            max_rollbacks: 3,
            tau_factor: 0.5,
            checkpoint_interval: 100,
        },
    }
}

fn seeds() -> Vec<SeedStructure> {
    let frames = atoms::read_extxyz(&data("aluminium_seeds.extxyz")).unwrap();
    let seed = |(number, frame): (usize, atoms::extxyz::Frame)| SeedStructure {
        name: number.to_string(),
        structure: frame.structure,
        walks: vec![WalkConditions {
            temperature: 600.0,
            tau: 0.15,
            volume_ramp: Some((1.0, 1.4)),
            ..WalkConditions::default()
        }],
    };
    frames.into_iter().enumerate().map(seed).collect()
}

fn data(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/data").join(path)
}

impl RunningAssignment {
    fn order(&self) -> (Duration, u64) {
        (self.0, self.1)
    }
}

impl PartialEq for RunningAssignment {
    fn eq(&self, other: &Self) -> bool {
        self.order() == other.order()
    }
}

impl Eq for RunningAssignment {}

impl PartialOrd for RunningAssignment {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for RunningAssignment {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.order().cmp(&other.order())
    }
}
