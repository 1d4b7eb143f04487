//! A campaign without a potential: synthetic mixture and structures, and arbitrary features.
pub mod eventful;
pub mod memory;
pub mod scripted;

use std::sync::Arc;

use atoms::{Cell, MinDistanceRule, Species, Structure, Uniform};
use calm::forgetting::ForgettingAlarm;
use calm::rules::{MaximumGrade, MaximumGradeUpdate, Positive};
use calm::{
    CollectionRule, Component, CovarianceUpdateKind, Mixture, Statistics, UpdateRule, UpdateSettings,
};
use orchestrator::grader::Grader;
use orchestrator::selector::{
    CampaignMode, OnForgetting, PotentialVersion, Scheduling, SeedStructurePlan, Selector, SelectorSettings,
    SelectorSnapshot, TrainingFrames, UpdateProtocol,
};
use store::records::{AtomGrades, Commit};
use wire::messages::{Assignment, AssignmentReport, Outcome, WalkEnd, WalkProgress};
use wire::{
    CampaignId, Candidate, CandidateBlock, CandidateId, CompletionCoefficients, ContentHash, WalkConditions,
};

pub const CAMPAIGN: CampaignId = CampaignId([0x9f; 16]);
pub const DIMENSION: usize = 3;
pub const ATOMS: usize = 2;
/// Shortest distance in the seed structures, Å; candidates must keep three quarters of it.
pub const SHORTEST: f64 = 2.8;

/// Centroids of the two components.
const CENTROIDS: [[f64; DIMENSION]; 2] = [[0.0; DIMENSION], [20.0, 0.0, 0.0]];

pub fn aluminium() -> Species {
    "Al".parse().unwrap()
}

/// Two components with unit covariance and θ = 1: γ is the distance of **z** from the nearer centroid.
pub fn mixture() -> Arc<Mixture> {
    mixture_of(0)
}

/// The original mixture of a version of the potential: later ones have a larger θ, 1 + version / 4.
pub fn mixture_of(version: u32) -> Arc<Mixture> {
    let theta = 1.0 + 0.25 * f64::from(version);
    let identity: Vec<f64> =
        (0..DIMENSION * DIMENSION).map(|k| f64::from(k % (DIMENSION + 1) == 0)).collect();
    let component = |centroid: [f64; DIMENSION]| {
        let scatter = identity.iter().map(|value| 100.0 * value).collect();
        let statistics = Statistics { scatter, count: 100.0, effective_count: 100.0 };
        Arc::new(Component::new(centroid.to_vec(), identity.clone(), theta, Some(statistics)).unwrap())
    };
    Arc::new(Mixture::new(0, vec![CENTROIDS.map(component).to_vec()]).unwrap())
}

/// Two aluminium atoms at this distance, Å, in a cell that depends on the number.
pub fn structure(number: u64, distance: f64) -> Structure {
    Structure {
        species: vec![aluminium(); ATOMS],
        positions: vec![[1e-6 * number as f64, 0.0, 0.0], [1e-6 * number as f64, distance, 0.0]],
        cell: Cell::orthorhombic(12.0, 12.0, 12.0),
        periodic: [true; 3],
    }
}

pub fn seed_structure(number: usize) -> SeedStructurePlan {
    SeedStructurePlan {
        name: format!("seed-{number}"),
        structure: structure(1_000_000 + number as u64, SHORTEST),
        walks: vec![WalkConditions::default()],
    }
}

pub fn grader() -> Grader {
    Grader::new(vec![aluminium()], vec![4.0])
}

pub fn positive(number: f64) -> Positive {
    number.try_into().unwrap()
}

pub fn settings(mode: CampaignMode) -> SelectorSettings {
    SelectorSettings {
        mode,
        walks_per_round: 2,
        steps_per_assignment: 10,
        update: UpdateProtocol::Cumulative,
        search: UpdateSettings {
            covariance_update: CovarianceUpdateKind::Convex,
            alpha_values: None,
            stop: UpdateRule::MaximumGrade(MaximumGradeUpdate { target: positive(1.25) }),
        },
        forgetting_alarm: ForgettingAlarm::default(),
        on_forgetting: OnForgetting::default(),
        collection: CollectionRule::MaximumGrade(MaximumGrade { threshold: positive(1.5) }),
        max_per_walk: 3,
        max_per_seed_structure: None,
        max_structures: None,
        max_steps_without_structure: None,
        stop_groups: Vec::new(),
        control: false,
        control_share: 0.5,
        min_distances: MinDistanceRule::Uniform(Uniform::default()),
        max_grade: None,
        declined_feature_bytes: 1 << 20,
        version: Default::default(),
        refit_at: None,
    }
}

/// A model of completion whose probability is γ₀ / (γ₀ + γ_max).
pub fn completes_up_to(gamma: f64) -> CompletionCoefficients {
    let weights = vec![-1.0, 0.0, 0.0, 0.0];
    CompletionCoefficients { elements: vec![aluminium().atomic_number()], intercept: gamma.ln(), weights }
}

pub fn restore(settings: &SelectorSettings, seeds: usize, snapshot: SelectorSnapshot) -> Selector {
    try_restore(settings, seeds, None, snapshot).unwrap()
}

/// A selector with these seed structures.
pub fn restore_with(
    settings: &SelectorSettings,
    seeds: Vec<SeedStructurePlan>,
    snapshot: SelectorSnapshot,
) -> Selector {
    let original = mixture_of(settings.version.version);
    Selector::restore(settings.clone(), CAMPAIGN, seeds, grader(), original, None, snapshot).unwrap()
}

pub fn try_restore(
    settings: &SelectorSettings,
    seeds: usize,
    training: Option<TrainingFrames>,
    snapshot: SelectorSnapshot,
) -> Result<Selector, orchestrator::selector::SelectorError> {
    let seeds = (0..seeds).map(seed_structure).collect();
    let original = mixture_of(settings.version.version);
    Selector::restore(settings.clone(), CAMPAIGN, seeds, grader(), original, training, snapshot)
}

/// A selector at the start of a campaign, with its walks.
pub fn begin(settings: &SelectorSettings, seeds: usize) -> Selector {
    let mut selector = restore(settings, seeds, SelectorSnapshot::default());
    selector.start_walks();
    selector
}

/// The next assignment, which must exist.
pub fn next_assignment(selector: &mut Selector) -> Assignment {
    next_assignment_of(0, selector)
}

/// The next assignment of this walker, which must exist.
pub fn next_assignment_of(walker: u32, selector: &mut Selector) -> Assignment {
    match selector.next_assignment(walker) {
        Scheduling::Assign(assignment) => *assignment,
        other => panic!("expected an assignment, found {other:?}"),
    }
}

/// Features of a structure: the first atom at the first centroid, the second at **z** from it, so γ = |z|.
pub fn features(z: [f64; DIMENSION]) -> Vec<f64> {
    [CENTROIDS[0], z].concat()
}

/// The largest γ of these features.
pub fn gamma_max(mixture: &Mixture, z: [f64; DIMENSION]) -> f64 {
    let mut grades = calm::Grades::default();
    grades.evaluate(mixture, &[0; ATOMS], &features(z), None).unwrap();
    grades.maximum()
}

/// The block that a walker would send for a structure with these features.
pub fn block(
    assignment: &Assignment,
    mixture: &Mixture,
    progress: &WalkProgress,
    structure: Structure,
    z: [f64; DIMENSION],
) -> CandidateBlock {
    expanded_block(assignment, mixture, progress, structure, z, 1.0)
}

/// The same with this V/V₀.
pub fn expanded_block(
    assignment: &Assignment,
    mixture: &Mixture,
    progress: &WalkProgress,
    structure: Structure,
    z: [f64; DIMENSION],
    relative_volume: f64,
) -> CandidateBlock {
    let features = features(z);
    let grades = grader().bonds(&structure).unwrap().grade(mixture, &features);
    // What cannot be graded is offered nevertheless.
    let grades =
        grades.unwrap_or_else(|_| AtomGrades { gamma: vec![9.0; ATOMS], gamma_nbr: vec![9.0; ATOMS] });
    CandidateBlock::encode(&Candidate {
        id: CandidateId {
            campaign: assignment.campaign,
            walk: assignment.walk,
            segment: progress.segment,
            step: progress.step,
            content: ContentHash::from_structure(&structure),
        },
        origin: assignment.origin,
        mixture_version: mixture.version(),
        temperature: progress.temperature,
        relative_volume,
        energy: -3.0,
        virial: [[0.5; 3]; 3],
        forces: vec![[0.1, -0.2, 0.3]; structure.len()],
        structure,
        gamma: grades.gamma,
        gamma_nbr: grades.gamma_nbr,
        features,
    })
}

pub fn at(step: u64) -> WalkProgress {
    WalkProgress { step, temperature: 300.0, relative_volume: 1.0, ..WalkProgress::default() }
}

pub fn report(assignment: &Assignment, outcome: Outcome, progress: WalkProgress) -> AssignmentReport {
    let checkpoint = format!("step {}", progress.step).into_bytes();
    AssignmentReport {
        walk: assignment.walk,
        assignment: assignment.number,
        outcome,
        checkpoint,
        progress,
        start: None,
        trace: Vec::new(),
        frames: Vec::new(),
    }
}

/// A report with a candidate at a step: the structure with this number and these features.
pub fn offer(
    selector: &Selector,
    assignment: &Assignment,
    step: u64,
    structure: Structure,
    z: [f64; DIMENSION],
) -> AssignmentReport {
    let block = block(assignment, selector.mixture(), &at(step), structure, z);
    report(assignment, Outcome::Candidate(block), at(step))
}

pub fn ended(assignment: &Assignment, step: u64, end: WalkEnd) -> AssignmentReport {
    report(assignment, Outcome::Ended(end), at(step))
}

/// The settings with this version of the potential, trained from the one before.
pub fn with_version(settings: &SelectorSettings, version: u32) -> SelectorSettings {
    let file = |name| format!("{name} {version}");
    let version = PotentialVersion {
        version,
        parent: version.saturating_sub(1),
        model: file("model"),
        mixture: file("mixture"),
    };
    SelectorSettings { version, refit_at: None, ..settings.clone() }
}

/// The selector's decision on a report that completes its round.
pub fn decided(selector: &mut Selector, report: AssignmentReport) -> Commit {
    selector.report(report).unwrap().expect("no other report is waited for")
}

/// Kind of each decision, with the reason if it declines.
pub fn kinds(commit: &Commit) -> Vec<String> {
    let kind = |decision: &store::records::Decision| match decision.detail.get("reason") {
        Some(reason) if decision.kind == "declined" => format!("declined {}", reason.as_str().unwrap()),
        _ => decision.kind.to_owned(),
    };
    commit.decisions.iter().map(kind).collect()
}

pub fn value<'a>(commit: &'a Commit, name: &str) -> &'a str {
    let mut found = commit.values.iter().rev().filter(|(key, _)| key == name);
    &found.next().unwrap_or_else(|| panic!("no value {name}")).1
}
