//! The time that walks spend waiting for each other: the walks of the aluminium campaign of `configs/`, one
//! walker each, in live mode and in rounds. Dynamics and decisions are real and run one after another on this
//! machine; a simulated clock that advances by the processor time of each assignment gives the time they would
//! take in parallel.
//!
//! `cargo bench --bench rounds`; a number after `--` sets the steps per assignment. `-- controls` compares how busy 16 walkers
//! are, with control walks and five walks of each seed structure, and when the first control frame is decided. The results
//! are in `docs/benchmarks.md`.

use std::cmp::Reverse;
use std::collections::{BTreeSet, BinaryHeap};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use atoms::MinDistanceRule;
use calm::forgetting::ForgettingAlarm;
use calm::{Artifact, UpdateSettings};
use md::{BarostatSettings, LangevinSettings, ThermostatSettings};
use orchestrator::grader::Grader;
use orchestrator::selector::{
    CampaignMode, OnForgetting, Scheduling, SeedStructurePlan, Selector, SelectorSettings, SelectorSnapshot,
    UpdateProtocol,
};
use potentials::grace::{GraceModel, Threads};
use potentials::{ZblWindow, ZblWindows};
use rustix::time::{ClockId, clock_gettime};
use wire::messages::{AssignmentReport, Outcome};
use wire::{CampaignId, CandidateBlock, Origin, WalkConditions};
use workers::cell_bias::CellBiasSettings;
use workers::settings::{GuardSettings, WalkSettings};
use workers::walk::{WalkContext, advance};

/// Default steps per assignment, as in `configs/`.
const STEPS_PER_ASSIGNMENT: u64 = 250;

/// Walkers of the comparison with control walks.
const WALKERS: usize = 16;

/// Temperatures of its walks from each seed structure, K.
const TEMPERATURES: [f64; 5] = [300.0, 450.0, 600.0, 750.0, 900.0];

fn main() {
    if std::env::args().any(|argument| argument == "controls") {
        return compare_schedules();
    }
    let steps_per_assignment =
        std::env::args().skip(1).find_map(|text| text.parse().ok()).unwrap_or(STEPS_PER_ASSIGNMENT);
    println!("assignments of {steps_per_assignment} steps");
    println!("{:<16} {:>10} {:>10} {:>12} {:>14}", "", "candidates", "accepted", "seconds", "walkers busy");
    let [live, rounds] = [CampaignMode::Live, CampaignMode::Reproducible].map(|mode| {
        // One walker per walk, so that every assignment starts at once.
        let walks = seed_structures(&[600.0]);
        let settings =
            SelectorSettings { mode, walks_per_round: walks.len(), steps_per_assignment, ..settings() };
        let campaign = Campaign::run(settings, walks.len(), walks);
        let Campaign { candidates, accepted, time, .. } = campaign;
        let (seconds, busy) = (time.as_secs_f64(), 100.0 * campaign.busy);
        println!("{:<16} {candidates:>10} {accepted:>10} {seconds:>12.1} {busy:>12.0} %", mode.name());
        campaign
    });
    let rate = |campaign: &Campaign| f64::from(campaign.candidates) / campaign.time.as_secs_f64();
    println!("candidates an hour, live over rounds: {:.2}", rate(&live) / rate(&rounds));
}

/// Rounds of several sizes, and live mode with several shares of control walks.
fn compare_schedules() {
    let base = SelectorSettings { control: true, max_per_walk: 3, ..settings() };
    let rounds = [1, 8, 32].map(|walks_per_round| {
        let settings = SelectorSettings { mode: CampaignMode::Reproducible, walks_per_round, ..base.clone() };
        (format!("reproducible, walks_per_round = {walks_per_round}"), settings)
    });
    let live = [0.25, 0.5].map(|control_share| {
        (format!("live, control_share = {control_share}"), SelectorSettings { control_share, ..base.clone() })
    });
    println!("{:<36} {:>8} {:>14} {:>32}", "", "seconds", "walkers busy", "begun before the first control");
    for (name, settings) in rounds.into_iter().chain(live) {
        let campaign = Campaign::run(settings, WALKERS, seed_structures(&TEMPERATURES));
        let [busy, begun] = [campaign.busy, campaign.begun_before_control].map(|share| 100.0 * share);
        println!("{name:<36} {:>8.1} {busy:>12.0} % {begun:>30.0} %", campaign.time.as_secs_f64());
    }
}

/// Result of a campaign.
#[derive(Default)]
struct Campaign {
    candidates: u32,
    accepted: u32,
    /// Time on the simulated clock of parallel walkers.
    time: Duration,
    /// Processor time of all walkers, divided by their total lifetime.
    busy: f64,
    /// Share of the biased walks that had started when the first control frame was decided.
    begun_before_control: f64,
}

/// A running assignment: when it ends, the order of start for ties, and its report.
struct RunningAssignment(Duration, u64, AssignmentReport);

impl Campaign {
    fn run(settings: SelectorSettings, walkers: usize, seeds: Vec<SeedStructurePlan>) -> Self {
        let model = Arc::new(GraceModel::load(&data("al_eam_1l/kokkos.npz")).unwrap());
        let walks: usize = seeds.iter().map(|seed| seed.walks.len()).sum();
        let mut selector = selector(settings, seeds, &model);
        let context = WalkContext {
            model: model.clone(),
            threads: Threads::default(),
            settings: Arc::new(walk_settings()),
            original: Arc::clone(selector.original()),
        };
        selector.start_walks();
        let (mut campaign, mut running, mut number) = (Self::default(), BinaryHeap::new(), 0);
        let (mut work, mut begun, mut has_control) = (Duration::ZERO, BTreeSet::new(), false);
        loop {
            while running.len() < walkers {
                let Scheduling::Assign(assignment) = selector.next_assignment(0) else { break };
                if assignment.origin == Origin::Biased && !has_control {
                    begun.insert(assignment.walk);
                }
                let used = processor_time();
                let report =
                    advance(&context, &assignment, Arc::clone(selector.mixture()), || false, |_| {}).unwrap();
                let taken = processor_time() - used;
                work += taken;
                number += 1;
                let report = report.map_candidate(|candidate| CandidateBlock::encode(&candidate));
                running.push(Reverse(RunningAssignment(campaign.time + taken, number, report)));
            }
            let Some(Reverse(RunningAssignment(ended, _, report))) = running.pop() else { break };
            campaign.time = ended;
            campaign.candidates += u32::from(matches!(report.outcome, Outcome::Candidate(_)));
            let commit = selector.report(report).unwrap().unwrap_or_default();
            let of_kind = |kind| commit.decisions.iter().filter(|decision| decision.kind == kind).count();
            campaign.accepted += of_kind("accepted") as u32;
            has_control |= of_kind("control") > 0;
        }
        campaign.busy = work.as_secs_f64() / (walkers as f64 * campaign.time.as_secs_f64());
        campaign.begun_before_control = begun.len() as f64 / walks as f64;
        campaign
    }
}

/// Processor time of this thread, which other load on the machine does not affect.
fn processor_time() -> Duration {
    Duration::try_from(clock_gettime(ClockId::ThreadCPUTime)).unwrap()
}

/// Live mode without control walks.
fn settings() -> SelectorSettings {
    let rule = "rule = 'atom_count'\nthreshold = 1.3\nfraction = 0.15\nmin_atoms = 3\n";
    SelectorSettings {
        mode: CampaignMode::Live,
        walks_per_round: 1,
        steps_per_assignment: STEPS_PER_ASSIGNMENT,
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
        max_steps_without_structure: None,
        stop_groups: Vec::new(),
        control: false,
        control_share: 0.5,
        min_distances: MinDistanceRule::default(),
        max_grade: None,
        declined_feature_bytes: 0,
        version: Default::default(),
        refit_at: None,
    }
}

fn selector(settings: SelectorSettings, seeds: Vec<SeedStructurePlan>, model: &GraceModel) -> Selector {
    let n = model.elements().len();
    let cutoffs = (0..n * n).map(|k| model.pair_cutoff(k / n, k % n)).collect();
    let grader = Grader::new(model.elements().to_vec(), cutoffs);
    let original = Arc::new(Artifact::load(data("al_eam_1l/gmm_artifacts.npz")).unwrap().mixture);
    let (campaign, snapshot) = (CampaignId([1; 16]), SelectorSnapshot::default());
    Selector::restore(settings, campaign, seeds, grader, original, None, snapshot).unwrap()
}

fn walk_settings() -> WalkSettings {
    WalkSettings {
        rng_seed: 1,
        thermostat: ThermostatSettings::Langevin(LangevinSettings { friction: 0.01 }),
        time_step: None,
        equilibration_steps: 500,
        biased_steps: 2000,
        bias_averaging_steps: 10,
        bias_norm_interval: 1,
        barostat: BarostatSettings::default(),
        reference_steps: 0,
        cell_bias: CellBiasSettings::default(),
        remove_update_work: false,
        trace_interval: 50,
        trajectory_interval: 0,
        max_frames: 64,
        skin: 0.5,
        collection: toml::from_str("rule = 'atom_count'\nthreshold = 1.3\nfraction = 0.15\nmin_atoms = 3")
            .unwrap(),
        min_interval: 200,
        min_interval_after_decline: 20,
        zbl: Some(ZblWindows::Uniform(ZblWindow { inner: 1.6, outer: 2.4 })),
        wall: None,
        guard: GuardSettings {
            min_distances: MinDistanceRule::default(),
            max_grade: None,
            max_temperature: 20_000.0,
            rollback: true,
            max_consecutive_rejections: 10,
            max_rollbacks: 3,
            tau_factor: 0.5,
            checkpoint_interval: 100,
        },
    }
}

/// The seed structures, with a walk at each of these temperatures, K.
fn seed_structures(temperatures: &[f64]) -> Vec<SeedStructurePlan> {
    let frames = atoms::read_extxyz(&data("aluminium_seeds.extxyz")).unwrap();
    let conditions = |temperature: &f64| WalkConditions {
        temperature: *temperature,
        tau: 0.15,
        cell: wire::CellConditions::VolumeRamp { from: 1.0, to: 1.4 },
        ..WalkConditions::default()
    };
    let seed = |(number, frame): (usize, atoms::extxyz::Frame)| SeedStructurePlan {
        name: number.to_string(),
        structure: frame.structure,
        walks: temperatures.iter().map(conditions).collect(),
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
