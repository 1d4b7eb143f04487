//! Assignments of a walk: pure functions, the bias force, and leaving a trap.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use atoms::{
    Evaluation, MinDistanceRule, NeighbourList, Potential, Structure, Uniform, Vec3, cell, read_extxyz,
};
use calm::{Artifact, CollectionRule, Grades, Mixture};
use md::{BarostatSettings, LangevinSettings, ThermostatSettings};
use potentials::grace::{Grace, GraceModel, PullBack, Threads};
use potentials::{WallSettings, ZblWindow, ZblWindows};
use wire::messages::{Assignment, AssignmentReport, Outcome, Verdict, WalkEnd};
use wire::{CampaignId, Candidate, CellConditions, Origin, WalkConditions, WalkId};
use workers::bias::BiasedPotential;
use workers::cell_bias::CellBiasSettings;
use workers::settings::{GuardSettings, WalkSettings};
use workers::walk::{WalkContext, advance, has_known_layout};

use crate::mutate;

fn data(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/data").join(path)
}

pub fn seed_structure(name: &str) -> Structure {
    let frames = read_extxyz(&data("aluminium_seeds.extxyz")).unwrap();
    frames.into_iter().find(|frame| frame.info["name"].text() == Some(name)).unwrap().structure
}

pub fn model() -> Arc<GraceModel> {
    Arc::new(GraceModel::load(&data("al_eam_1l/kokkos.npz")).unwrap())
}

pub fn mixture() -> Arc<Mixture> {
    Arc::new(Artifact::load(data("al_eam_1l/gmm_artifacts.npz")).unwrap().mixture)
}

pub fn uniform_zbl(inner: f64, outer: f64) -> Option<ZblWindows> {
    Some(ZblWindows::Uniform(ZblWindow { inner, outer }))
}

pub fn settings() -> WalkSettings {
    WalkSettings {
        rng_seed: 3,
        thermostat: ThermostatSettings::Langevin(LangevinSettings { friction: 0.01 }),
        time_step: None,
        equilibration_steps: 20,
        biased_steps: 600,
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
        collection: toml::from_str("rule = 'atom_count'").unwrap(),
        min_interval: 200,
        min_interval_after_decline: 20,
        zbl: uniform_zbl(1.6, 2.4),
        wall: None,
        guard: GuardSettings {
            min_distances: MinDistanceRule::Uniform(Uniform::default()),
            max_grade: None,
            max_temperature: 20_000.0,
            rollback: true,
            max_consecutive_rejections: 5,
            max_rollbacks: 3,
            tau_factor: 0.5,
            checkpoint_interval: 100,
        },
    }
}

pub fn conditions() -> WalkConditions {
    WalkConditions {
        temperature: 600.0,
        tau: 0.15,
        cell: CellConditions::VolumeRamp { from: 1.0, to: 1.4 },
        ..WalkConditions::default()
    }
}

pub fn assignment(structure: Structure, until: u64) -> Assignment {
    Assignment {
        campaign: CampaignId([1; 16]),
        walk: WalkId(0),
        number: 0,
        origin: Origin::Biased,
        random_walk: WalkId(0),
        seed_structure: structure,
        conditions: conditions(),
        checkpoint: None,
        verdict: None,
        last_step: until,
        frame_steps: Vec::new(),
        threshold_factor: 1.0,
    }
}

pub fn run(settings: &WalkSettings, assignment: &Assignment) -> AssignmentReport<Candidate> {
    let context = context(settings.clone());
    advance(&context, assignment, mixture(), || false, |_| {}).unwrap()
}

/// What walks with these settings share; the original mixture is that of [`mixture`].
pub fn context(settings: WalkSettings) -> WalkContext {
    let (model, threads, settings) = (model(), Threads::default(), Arc::new(settings));
    WalkContext { model, threads, settings, original: mixture() }
}

/// The first 150 steps of a walk under these conditions.
pub fn first_of(seed: &str, conditions: WalkConditions) -> Assignment {
    Assignment { conditions, ..assignment(seed_structure(seed), 150) }
}

/// Runs a walk, one assignment as long as the first after the other, with every candidate accepted, until it ends.
pub fn whole_walk(settings: &WalkSettings, first: Assignment) -> Vec<AssignmentReport<Candidate>> {
    let steps_per_assignment = first.last_step;
    let mut next = first;
    let mut reports = Vec::new();
    loop {
        let report = run(settings, &next);
        next.checkpoint = Some(report.checkpoint.clone());
        next.last_step = report.progress.step + steps_per_assignment;
        next.number += 1;
        next.verdict = matches!(report.outcome, Outcome::Candidate(_)).then_some(Verdict::Accepted);
        let ended = matches!(report.outcome, Outcome::Ended(_));
        reports.push(report);
        if ended {
            return reports;
        }
    }
}

#[test]
fn a_split_assignment_gives_the_same_result() {
    let settings = WalkSettings { collection: never(), ..settings() };
    let whole = run(&settings, &assignment(seed_structure("vacancy"), 120));
    assert_eq!((&whole.outcome, whole.progress.step), (&Outcome::StepsDone, 120));
    let mut next = assignment(seed_structure("vacancy"), 0);
    for last_step in [1, 19, 20, 21, 33, 90, 120] {
        next.last_step = last_step;
        next.checkpoint = Some(run(&settings, &next).checkpoint);
    }
    assert_eq!(next.checkpoint, Some(whole.checkpoint));
}

/// It equilibrates there, like a walk from a seed structure of that volume.
#[test]
fn a_walk_begins_at_the_volume_of_its_ramp() {
    let frame = |structure: Structure, (from, to): (f64, f64)| {
        let settings = settings();
        let mut control = assignment(structure, 120);
        control.conditions.cell = CellConditions::VolumeRamp { from, to };
        (control.origin, control.frame_steps) = (Origin::Control, vec![40]);
        let Outcome::Candidate(frame) = run(&settings, &control).outcome else { panic!("no frame") };
        frame.structure
    };
    let seed = seed_structure("vacancy");
    let mut expanded = seed.clone();
    md::scale_volume(&mut expanded, 1.1);
    let (found, expected) = (frame(seed, (1.1, 1.32)), frame(expanded, (1.0, 1.2)));
    assert!((found.cell.volume() / expected.cell.volume() - 1.0).abs() < 1e-12);
    for (a, b) in found.positions.iter().zip(&expected.positions) {
        assert!(cell::norm(cell::sub(*a, *b)) < 1e-6, "{a:?} {b:?}");
    }
}

/// A checkpoint that an earlier build wrote, after 110 steps of the walk below, stays readable. If it does not, the layout has
/// changed: it needs another number (`LAYOUT`) and another file here, `now`.
#[test]
fn checkpoints_keep_their_layout() {
    let settings = WalkSettings { collection: never(), ..settings() };
    let mut next = assignment(seed_structure("vacancy"), 110);
    let now = run(&settings, &next).checkpoint;
    let kept = include_bytes!("data/walk.checkpoint").to_vec();
    assert!(has_known_layout(&kept) && has_known_layout(&now));
    assert!(!has_known_layout(&kept[1..]));
    let [kept, now] = [kept, now].map(|checkpoint| {
        (next.number, next.last_step, next.checkpoint) = (1, 130, Some(checkpoint));
        run(&settings, &next)
    });
    assert!(matches!(kept.outcome, Outcome::StepsDone) && kept.progress.step == 130, "{:?}", kept.outcome);
    // Other instruction sets have other last bits.
    let (kept, now) = (kept.progress.gamma_max, now.progress.gamma_max);
    assert!((kept / now - 1.0).abs() < 1e-6, "{kept} {now}");
}

/// A damaged checkpoint continues or ends its walk. `CALMWALK_MUTATIONS=5000` runs the long version.
#[test]
fn damaged_checkpoints_do_not_stop_a_walker() {
    let settings = WalkSettings { collection: never(), ..settings() };
    let mut next = assignment(seed_structure("vacancy"), 110);
    let checkpoint = run(&settings, &next).checkpoint;
    let context = context(settings);
    let mixture = mixture();
    next.last_step = 115;
    let mut refused = 0;
    for number in 0..mutate::mutations(60) {
        next.checkpoint = Some(mutate::mutated(&checkpoint, number));
        let go = || advance(&context, &next, Arc::clone(&mixture), || false, |_| {}).unwrap();
        let report = catch_unwind(AssertUnwindSafe(go));
        let report = report.unwrap_or_else(|_| panic!("a panic at mutation {number}"));
        let unreadable = |reason: &str| reason.contains("the walk's checkpoint cannot be read");
        match &report.outcome {
            Outcome::Ended(WalkEnd::Diverged { reason }) if unreadable(reason) => {
                assert_eq!(Some(report.checkpoint), next.checkpoint);
                refused += 1;
            }
            Outcome::Ended(WalkEnd::InvalidStart { reason }) => panic!("this is not its start: {reason}"),
            _ => {}
        }
    }
    assert!(refused > 0);
}

pub fn never() -> CollectionRule {
    toml::from_str("rule = 'maximum_grade'\nthreshold = 1e9").unwrap()
}

#[test]
fn the_bias_is_the_hal_force() {
    let (model, mixture, structure) = (model(), mixture(), seed_structure("slab-111"));
    let species = &structure.species;
    let mut biased = BiasedPotential::new(
        Box::new(Grace::new(Arc::clone(&model))),
        Arc::clone(&mixture),
        None,
        10,
        species,
    )
    .unwrap();
    biased.tau = 0.3;
    let mut neighbours = NeighbourList::new(model.cutoff(), 0.0);
    let (mut force_norm, mut gradient_norm) = (0.0, 0.0);
    for call in 0..14 {
        let mut moved = structure.clone();
        let shift = |r: &mut Vec3, k: usize| r[k % 3] += 0.02 * ((7 * k + 3 * call) as f64).sin();
        moved.positions.iter_mut().enumerate().for_each(|(k, r)| shift(r, k));
        neighbours.update(&moved).unwrap();
        let mut out = Evaluation::default();
        biased.evaluate(&moved, &neighbours, &mut out).unwrap();
        let (physical, gradient) = reference(&model, &mixture, &moved, &neighbours);
        let sum = |vectors: &[Vec3]| vectors.iter().map(|v| cell::norm(*v)).sum::<f64>();
        let weight = if call == 0 { 1.0 } else { 0.1 };
        force_norm += weight * (sum(&physical.forces) - force_norm);
        gradient_norm += weight * (sum(&gradient.gradient) - gradient_norm);
        let scale = if call < 10 { 0.0 } else { 0.3 * force_norm / gradient_norm };
        for (found, (force, gradient)) in
            out.forces.iter().zip(physical.forces.iter().zip(&gradient.gradient))
        {
            let expected = cell::add(*force, cell::scale(*gradient, scale));
            assert!(cell::norm(cell::sub(*found, expected)) <= 1e-10 * (1.0 + cell::norm(expected)));
        }
        assert_eq!(biased.physical(), &physical);
    }
}

/// Forces of the potential alone and ∇Σγ.
pub fn reference(
    model: &Arc<GraceModel>,
    mixture: &Mixture,
    structure: &Structure,
    neighbours: &NeighbourList,
) -> (Evaluation, PullBack) {
    let mut grace = Grace::new(Arc::clone(model));
    grace.forward(structure, neighbours).unwrap();
    let elements = model.element_indices(&structure.species).unwrap();
    let (mut grades, mut cotangent) = (Grades::default(), vec![0.0; grace.features().len()]);
    grades.evaluate(mixture, &elements, grace.features(), Some(&mut cotangent)).unwrap();
    let (mut evaluation, mut pull_back) = (Evaluation::default(), PullBack::default());
    grace.backward(Some(&cotangent), &mut evaluation, &mut pull_back);
    (evaluation, pull_back)
}

/// The trap of the reference's walker: τ = 2.0 on a model of one phase, and a ZBL that ends at 1.8 Å.
#[test]
fn a_trapped_walk_rolls_back_with_a_smaller_bias() {
    let settings = WalkSettings { zbl: uniform_zbl(1.0, 1.8), ..settings() };
    let reports = whole_walk(&settings, first_of("fcc-100", WalkConditions { tau: 2.0, ..conditions() }));
    let last = reports.last().unwrap();
    assert!(last.progress.rollbacks >= 1, "{last:?}");
    assert_eq!(last.progress.segment, last.progress.rollbacks);
    assert!(
        last.progress.last_rollback.is_some_and(|(from, to)| from > to && to >= settings.equilibration_steps)
    );
    assert_eq!(last.progress.tau, 2.0 * 0.5_f64.powi(last.progress.rollbacks as i32));
    assert!(last.progress.rejected >= u64::from(5 * last.progress.rollbacks));
    let candidates = reports.iter().filter(|report| matches!(report.outcome, Outcome::Candidate(_))).count();
    assert!(candidates >= 2, "after its return the walk collects again");
}

/// Steps between two candidates along the path that joins them, across roll backs.
#[test]
fn the_interval_between_collections_holds_across_roll_backs() {
    let guard = GuardSettings { tau_factor: 0.8, max_rollbacks: 6, ..settings().guard };
    let settings = WalkSettings { zbl: uniform_zbl(1.0, 1.8), min_interval: 120, guard, ..settings() };
    let reports = whole_walk(&settings, first_of("fcc-097", WalkConditions { tau: 2.0, ..conditions() }));
    let candidate = |report: &AssignmentReport<Candidate>| match &report.outcome {
        Outcome::Candidate(candidate) => Some((candidate.id.segment, candidate.id.step)),
        _ => None,
    };
    let candidates: Vec<_> = reports.iter().filter_map(candidate).collect();
    let segments = reports.last().unwrap().progress.segment;
    assert!(segments >= 2 && candidates.len() >= 2, "{segments} {candidates:?}");
    // Two candidates of one segment are on one path; those of two segments are at least as far apart as their
    // steps.
    for (k, (segment, step)) in candidates.iter().enumerate() {
        for (earlier, at) in &candidates[..k] {
            let apart = if segment == earlier {
                step.abs_diff(*at)
            } else {
                step.saturating_sub(20) + at.saturating_sub(20)
            };
            assert!(apart >= 120, "{candidates:?}");
        }
    }
}

#[test]
fn the_skin_changes_nothing() {
    // A cluster that loses an atom: when this is noticed must not depend on when the list was built.
    let mut cluster = seed_structure("fcc-100");
    cluster.periodic = [false; 3];
    cluster.species.truncate(5);
    cluster.positions.truncate(5);
    let ends = [0.1, 0.5, 3.0].map(|skin| {
        let settings = WalkSettings { skin, biased_steps: 4000, collection: never(), ..settings() };
        let conditions = WalkConditions { temperature: 6000.0, ..conditions() };
        let report = run(&settings, &Assignment { conditions, ..assignment(cluster.clone(), 4020) });
        (report.outcome, report.progress.step)
    });
    let lost = |outcome: &Outcome<Candidate>| matches!(outcome, Outcome::Ended(WalkEnd::Diverged { reason }) if reason.contains("no neighbour"));
    assert!(lost(&ends[0].0), "{:?}", ends[0]);
    assert!(ends.iter().all(|end| *end == ends[0]), "{ends:?}");
}

/// Of its collections, a walk remembers those that a roll back could still count from.
#[test]
fn the_checkpoint_does_not_grow_with_collections() {
    let collection: CollectionRule = toml::from_str("rule = 'maximum_grade'\nthreshold = 1e-9").unwrap();
    let guard = GuardSettings { checkpoint_interval: 20, ..settings().guard };
    let settings = WalkSettings { collection, min_interval: 1, trace_interval: 0, guard, ..settings() };
    let context = context(settings);
    let (mut next, mixture) = (first_of("vacancy", conditions()), mixture());
    let mut sizes = Vec::new();
    for _ in 0..200 {
        let report = advance(&context, &next, Arc::clone(&mixture), || false, |_| {}).unwrap();
        assert!(matches!(report.outcome, Outcome::Candidate(_)), "{:?}", report.outcome);
        sizes.push(report.checkpoint.len());
        next.checkpoint = Some(report.checkpoint);
        next.verdict = Some(Verdict::Accepted);
        next.last_step += 1000;
    }
    let largest = |sizes: &[usize]| *sizes.iter().max().unwrap();
    // Steps are written in as few bytes as they need.
    assert!(largest(&sizes[100..]) < largest(&sizes[..100]) + 60, "{sizes:?}");
}

/// Five hot atoms of a cluster fly apart; a wall holds them together, also where the walk goes on from a checkpoint. A wall is nothing
/// to a crystal.
#[test]
fn a_wall_holds_a_cluster_together() {
    let mut cluster = seed_structure("fcc-100");
    cluster.periodic = [false; 3];
    cluster.species.truncate(5);
    cluster.positions.truncate(5);
    let end = |wall: Option<WallSettings>, structure: &Structure, steps: &[u64]| {
        let settings = WalkSettings { wall, collection: never(), ..settings() };
        let conditions = WalkConditions { temperature: 6000.0, cell: CellConditions::Fixed, ..conditions() };
        let mut next = Assignment { conditions, ..assignment(structure.clone(), 0) };
        for last_step in steps {
            next.last_step = *last_step;
            let report = run(&settings, &next);
            next.number += 1;
            next.checkpoint = Some(report.checkpoint);
            if report.outcome != Outcome::StepsDone {
                return (report.outcome, report.progress);
            }
        }
        (Outcome::StepsDone, run(&settings, &next).progress)
    };
    let lost = |outcome: &Outcome<Candidate>| matches!(outcome, Outcome::Ended(WalkEnd::Diverged { reason }) if reason.contains("no neighbour"));
    let (free, _) = end(None, &cluster, &[400]);
    assert!(lost(&free), "{free:?}");
    let wall = Some(WallSettings { margin: 1.0, stiffness: 5.0 });
    let (held, progress) = end(wall, &cluster, &[400]);
    assert_eq!((&held, progress.step), (&Outcome::StepsDone, 400));
    assert_eq!(end(wall, &cluster, &[100, 250, 400]), (held, progress));
    let crystal = seed_structure("fcc-100");
    assert_eq!(end(wall, &crystal, &[60]), end(None, &crystal, &[60]));
}

#[test]
fn a_walk_that_cannot_leave_a_trap_ends() {
    let min_distances = MinDistanceRule::Uniform(Uniform { min_distance: 3.0, fraction: 0.75 });
    let guard = GuardSettings { min_distances, ..settings().guard };
    let collection: CollectionRule = toml::from_str("rule = 'maximum_grade'\nthreshold = 0.01").unwrap();
    let settings = WalkSettings { collection, guard, ..settings() };
    let first = first_of("fcc-100", WalkConditions { cell: CellConditions::Fixed, ..conditions() });
    let reports = whole_walk(&settings, first);
    let last = reports.last().unwrap();
    assert!(
        matches!(&last.outcome, Outcome::Ended(WalkEnd::Trapped { guard }) if guard == "shortest-bond"),
        "{last:?}"
    );
    assert_eq!(last.progress.rollbacks, settings.guard.max_rollbacks);
    assert!(last.progress.step < 600);
}

#[test]
fn without_rollbacks_a_refused_walk_continues() {
    let min_distances = MinDistanceRule::Uniform(Uniform { min_distance: 3.0, fraction: 0.75 });
    let guard = GuardSettings { min_distances, rollback: false, ..settings().guard };
    let collection: CollectionRule = toml::from_str("rule = 'maximum_grade'\nthreshold = 0.01").unwrap();
    let settings = WalkSettings { collection, guard, ..settings() };
    let first = first_of("fcc-100", WalkConditions { cell: CellConditions::Fixed, ..conditions() });
    let reports = whole_walk(&settings, first);
    let last = reports.last().unwrap();
    assert!(matches!(&last.outcome, Outcome::Ended(WalkEnd::Completed)), "{last:?}");
    assert_eq!((last.progress.rollbacks, last.progress.segment), (0, 0));
    assert!(last.progress.rejected > u64::from(settings.guard.max_consecutive_rejections), "{last:?}");
}

#[test]
fn a_diverging_walk_ends_with_its_reason() {
    let guard = GuardSettings { max_temperature: 900.0, ..settings().guard };
    let settings = WalkSettings { collection: never(), guard, ..settings() };
    let conditions = WalkConditions { temperature: 2500.0, ..conditions() };
    let first = Assignment { conditions, ..assignment(seed_structure("fcc-100"), 600) };
    let report = run(&settings, &first);
    let Outcome::Ended(WalkEnd::Diverged { reason }) = report.outcome else { panic!("{report:?}") };
    assert!(reason.contains("above the allowed 900 K"), "{reason}");
}

#[test]
fn a_control_walk_gives_the_requested_frames_and_follows_the_biased_one_until_the_bias_acts() {
    let settings = settings();
    let mut control = assignment(seed_structure("slab-111"), 90);
    control.origin = Origin::Control;
    control.walk = WalkId(9);
    control.frame_steps = vec![25, 90];
    let report = run(&settings, &control);
    let Outcome::Candidate(candidate) = &report.outcome else { panic!("{report:?}") };
    assert_eq!((candidate.id.step, candidate.origin), (25, Origin::Control));
    // The bias is zero for its first ten evaluations: up to step 30 both trajectories agree.
    let same = |last_step: u64| {
        let quiet = WalkSettings { collection: never(), ..settings.clone() };
        let biased = run(&quiet, &assignment(seed_structure("slab-111"), last_step));
        let mut control = Assignment { frame_steps: Vec::new(), ..control.clone() };
        control.last_step = last_step;
        let state = |report: &AssignmentReport<Candidate>| {
            (report.progress.temperature, report.progress.relative_volume)
        };
        state(&biased) == state(&run(&quiet, &control))
    };
    assert!(same(30));
    assert!(!same(60));
}
