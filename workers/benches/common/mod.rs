//! A biased walk of 108 atoms for benchmarks.

use std::sync::Arc;
use std::time::Instant;

use atoms::{Cell, MinDistanceRule, Species, Structure, Uniform};
use calm::Mixture;
use md::{BarostatSettings, LangevinSettings, NoseHooverSettings, ThermostatSettings};
use potentials::grace::{GraceModel, Threads};
use potentials::{ZblWindow, ZblWindows};
use wire::messages::{Assignment, AssignmentReport, Outcome};
use wire::{CampaignId, Candidate, CellConditions, ConstantPressure, Origin, WalkConditions, WalkId};
use workers::cell_bias::CellBiasSettings;
use workers::settings::{GuardSettings, WalkSettings};
use workers::walk::{WalkContext, advance};

/// What the cell of a walk does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Ensemble {
    /// The integrator of a volume ramp that goes nowhere, with Langevin dynamics.
    ConstantVolume,
    /// 1 bar, fully flexible, with Nosé–Hoover chains.
    ConstantPressure {
        /// Whether the cell is biased too.
        cell_bias: bool,
    },
}

/// An assignment of a walk with active bias, which starts at the same checkpoint each time.
#[derive(Clone)]
pub struct TimedWalk {
    context: WalkContext,
    mixture: Arc<Mixture>,
    assignment: Assignment,
    /// The structure where it starts.
    pub structure: Structure,
}

impl TimedWalk {
    pub fn new(
        model: &Arc<GraceModel>,
        mixture: &Arc<Mixture>,
        seed_structure: Structure,
        ensemble: Ensemble,
    ) -> Self {
        let context = |threshold| WalkContext {
            model: model.clone(),
            threads: Threads::default(),
            settings: Arc::new(settings(threshold, ensemble)),
            original: Arc::clone(mixture),
        };
        let mut assignment = assignment(seed_structure, ensemble, u64::MAX);
        // Any structure is a candidate from the first permitted step on.
        let report = run(&context(1e-9), &assignment, mixture);
        let Outcome::Candidate(candidate) = report.outcome else {
            panic!("the walk has ended before its bias began: {:?}", report.outcome)
        };
        assignment.checkpoint = Some(report.checkpoint);
        Self {
            context: context(1e9),
            mixture: Arc::clone(mixture),
            assignment,
            structure: candidate.structure,
        }
    }

    /// Seconds per step, averaged over `steps`.
    pub fn seconds(&mut self, steps: u64) -> f64 {
        self.assignment.last_step = EQUILIBRATION + 1 + steps;
        let start = Instant::now();
        let report = run(&self.context, &self.assignment, &self.mixture);
        let seconds = start.elapsed().as_secs_f64();
        assert_eq!(report.outcome, Outcome::StepsDone, "the walk makes all its steps");
        seconds / steps as f64
    }
}

fn run(
    context: &WalkContext,
    assignment: &Assignment,
    mixture: &Arc<Mixture>,
) -> AssignmentReport<Candidate> {
    advance(context, assignment, Arc::clone(mixture), || false, |_| {}).unwrap()
}

const EQUILIBRATION: u64 = 100;

/// Settings of the aluminium campaign; at constant volume every call has as many bonds. A structure is a
/// candidate if its largest grade is above `threshold`.
fn settings(threshold: f64, ensemble: Ensemble) -> WalkSettings {
    let chain = NoseHooverSettings { relaxation_time: 100.0, chain_length: 3 };
    // 75.9 GPa in eV/Å³, the paper's for aluminium.
    let cell_bias = CellBiasSettings { stress_scale: Some(0.474), ..CellBiasSettings::default() };
    WalkSettings {
        rng_seed: 3,
        thermostat: match ensemble {
            Ensemble::ConstantVolume => ThermostatSettings::Langevin(LangevinSettings { friction: 0.01 }),
            Ensemble::ConstantPressure { .. } => ThermostatSettings::NoseHoover(chain),
        },
        time_step: None,
        equilibration_steps: EQUILIBRATION,
        biased_steps: 10_000_000,
        bias_averaging_steps: 10,
        bias_norm_interval: 1,
        barostat: BarostatSettings::default(),
        reference_steps: 0,
        cell_bias,
        remove_update_work: false,
        trace_interval: 50,
        trajectory_interval: 0,
        max_frames: 64,
        skin: 0.5,
        collection: toml::from_str(&format!("rule = 'maximum_grade'\nthreshold = {threshold:e}"))
            .expect("a rule"),
        min_interval: 200,
        min_interval_after_decline: 20,
        zbl: Some(ZblWindows::Uniform(ZblWindow { inner: 1.6, outer: 2.4 })),
        wall: None,
        guard: GuardSettings {
            min_distances: MinDistanceRule::Uniform(Uniform { min_distance: 1.2, fraction: 0.5 }),
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

fn assignment(seed_structure: Structure, ensemble: Ensemble, until: u64) -> Assignment {
    let cell = match ensemble {
        Ensemble::ConstantVolume => CellConditions::VolumeRamp { from: 1.0, to: 1.0 },
        Ensemble::ConstantPressure { cell_bias } => {
            CellConditions::ConstantPressure(ConstantPressure { pressure: 1.0, start_volume: 1.0, cell_bias })
        }
    };
    Assignment {
        campaign: CampaignId([1; 16]),
        walk: WalkId(0),
        number: 0,
        origin: Origin::Biased,
        random_walk: WalkId(0),
        seed_structure,
        conditions: WalkConditions { temperature: 600.0, tau: 0.15, cell, ..WalkConditions::default() },
        checkpoint: None,
        verdict: None,
        last_step: until,
        frame_steps: Vec::new(),
        threshold_factor: 1.0,
    }
}

/// fcc, 108 atoms, alternating elements; `edge` of the cube of four atoms in Å.
pub fn crystal(elements: &[Species], edge: f64) -> Structure {
    const SITES: [[f64; 3]; 4] = [[0.0; 3], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]];
    const CELLS: usize = 3;
    let mut positions = Vec::new();
    for cell in 0..CELLS.pow(3) {
        let corner = [cell / (CELLS * CELLS), cell / CELLS % CELLS, cell % CELLS];
        positions
            .extend(SITES.iter().map(|site| std::array::from_fn(|k| edge * (corner[k] as f64 + site[k]))));
    }
    let length = edge * CELLS as f64;
    Structure {
        species: (0..positions.len()).map(|k| elements[k % elements.len()]).collect(),
        positions,
        cell: Cell::orthorhombic(length, length, length),
        periodic: [true; 3],
    }
}

/// Lower quartile, median, upper quartile.
pub fn quartiles(mut values: Vec<f64>) -> [f64; 3] {
    values.sort_by(f64::total_cmp);
    [1, 2, 3].map(|quarter| values[(values.len() - 1) * quarter / 4])
}
