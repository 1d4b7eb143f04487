//! The state of a walk between assignments, and its initial state.

use atoms::{MinDistances, NeighbourList, Potential, ShortestDistances, Structure};
use md::{CellMotion, Checkpoint, Dynamics, State, Stream, VolumeRamp};
use serde::{Deserialize, Serialize};
use wire::Origin;
use wire::messages::Assignment;

use super::constant_pressure::{ReferenceRun, cell_bias, start_reference_run};
use super::error::WalkError;
use crate::bias::{BiasState, BiasedPotential};
use crate::cell_bias::CellBias;
use crate::settings::WalkSettings;

/// Number of checkpoints kept for roll backs. The oldest one is used, so that a roll back leads out of the trap.
const MAX_CHECKPOINTS: usize = 2;

/// The checkpoint of a walk.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct WalkState {
    pub dynamics: Checkpoint,
    pub bias: BiasState,
    /// As long as it lasts; its dynamics are those of the walk.
    pub reference_run: Option<ReferenceRun>,
    /// V₀, Å³ (Å² for a slab, Å for a wire).
    pub reference_volume: f64,
    /// Of a walk with a biased cell.
    pub cell_bias: Option<CellBias>,
    /// Where the bias acts: version of the mixture, and Σγ under it.
    pub bias_sum: Option<(u64, f64)>,
    pub tau: f64,
    pub segment: u32,
    pub rollbacks: u32,
    /// Steps from which and to which the walk last rolled back.
    pub last_rollback: Option<(u64, u64)>,
    pub rejected: u64,
    pub max_consecutive_rejections: u32,
    /// First step at which a candidate may be offered.
    pub next_offer: u64,
    /// Points at which structures were collected.
    pub collected: Vec<CollectionPoint>,
    /// How close atoms may come.
    pub min_distances: MinDistances,
    /// Targets of roll backs, oldest first.
    pub good: Vec<GoodState>,
    pub gamma_max: f64,
    /// Number of points of the trace so far.
    pub trace_points: u64,
}

/// A state to which a walk can roll back.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct GoodState {
    pub dynamics: Checkpoint,
    pub bias: BiasState,
    pub cell_bias: Option<CellBias>,
}

/// A collection, as seen from the current path of the walk: it lies `beyond` steps off the path, which it left at
/// step `branch`.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct CollectionPoint {
    pub branch: u64,
    pub beyond: u64,
}

impl WalkState {
    /// Keeps the current state as a target of roll backs.
    pub fn keep_checkpoint(&mut self, dynamics: &Dynamics, potential: &BiasedPotential) {
        if self.good.len() == MAX_CHECKPOINTS {
            self.good.remove(0);
        }
        self.good.push(self.good_state(dynamics, potential));
    }

    /// The current state as a target of roll backs.
    pub fn good_state(&self, dynamics: &Dynamics, potential: &BiasedPotential) -> GoodState {
        let cell_bias = self.cell_bias.clone();
        GoodState { dynamics: dynamics.checkpoint().clone(), bias: potential.state, cell_bias }
    }

    /// The first step at which a candidate may be offered after a roll back to `step`. The interval to a collection
    /// counts along the path that joins the two: back from the collection along the abandoned piece, then forward
    /// again.
    pub fn offer_after_rollback(&mut self, step: u64, settings: &WalkSettings) -> u64 {
        for collected in self.collected.iter_mut().filter(|collected| collected.branch > step) {
            collected.beyond += collected.branch - step;
            collected.branch = step;
        }
        let offers = self.collected.iter().map(|c| c.branch + settings.min_interval.saturating_sub(c.beyond));
        offers.max().unwrap_or(0).max(step + settings.min_interval_after_decline)
    }
}

/// Starts a walk: at its seed structure with thermal velocities, or with its reference run.
pub(super) fn start(
    settings: &WalkSettings,
    assignment: &Assignment,
    potential: &mut BiasedPotential,
) -> Result<(Dynamics, WalkState), WalkError> {
    let (structure, conditions) = (&assignment.seed_structure, &assignment.conditions);
    let mut neighbours = NeighbourList::new(potential.cutoff(), 0.0);
    neighbours.update(structure)?;
    let min_distances =
        settings.guard.min_distances.limits(&ShortestDistances::from_neighbours(structure, &neighbours));
    let reference_volume = md::extent(structure);
    let cell_bias = cell_bias(settings, assignment, potential)?;
    let reference = start_reference_run(settings, assignment, potential)?;
    let reference_run = reference.as_ref().map(|_| ReferenceRun::default());
    let dynamics = match reference {
        Some(dynamics) => dynamics,
        None => start_dynamics(settings, assignment, structure.clone(), reference_volume, potential)?,
    };
    let mut state = WalkState {
        dynamics: dynamics.checkpoint().clone(),
        bias: BiasState::default(),
        reference_run,
        reference_volume,
        cell_bias,
        bias_sum: None,
        tau: if assignment.origin == Origin::Control { 0.0 } else { conditions.tau },
        segment: 0,
        rollbacks: 0,
        last_rollback: None,
        rejected: 0,
        max_consecutive_rejections: 0,
        next_offer: 0,
        collected: Vec::new(),
        min_distances,
        good: Vec::new(),
        gamma_max: 0.0,
        trace_points: 0,
    };
    state.keep_checkpoint(&dynamics, potential);
    Ok((dynamics, state))
}

/// The first state of a walk: `structure` with thermal velocities, at the volume at which the walk starts. V₀ in Å³
/// (Å² for a slab, Å for a wire).
pub(super) fn start_dynamics(
    settings: &WalkSettings,
    assignment: &Assignment,
    structure: Structure,
    reference_volume: f64,
    potential: &mut BiasedPotential,
) -> Result<Dynamics, WalkError> {
    let conditions = &assignment.conditions;
    let stream = Stream::new(settings.rng_seed, assignment.random_walk.0, 0);
    let mut start = State::thermal(structure, conditions.temperature, &stream);
    let ramp = conditions.volume_ramp.map(|(from, to)| {
        let ramp = VolumeRamp::new(&start, from, to, settings.biased_steps);
        VolumeRamp { start: settings.equilibration_steps, ..ramp }
    });
    // Equilibration runs at the volume at which the ramp begins.
    if let Some(ramp) = ramp.filter(|ramp| ramp.from != 1.0) {
        ramp.apply(&mut start.structure, 0);
    }
    // Likewise, the barostat moves the cell only afterwards.
    if let Some(constant) = conditions.constant_pressure {
        let ratio = constant.start_volume * reference_volume / md::extent(&start.structure);
        if ratio != 1.0 {
            md::scale_volume(&mut start.structure, ratio);
        }
    }
    let run = run_settings(settings, assignment, ramp.into(), stream);
    Ok(Dynamics::new(start, run, potential)?)
}

/// Settings of the dynamics of a walk.
pub(super) fn run_settings(
    settings: &WalkSettings,
    assignment: &Assignment,
    cell_motion: CellMotion,
    stream: Stream,
) -> md::DynamicsSettings {
    let species = &assignment.seed_structure.species;
    let time_step = settings.time_step.unwrap_or_else(|| md::default_time_step(species));
    let thermostat = settings.thermostat.start(assignment.conditions.temperature);
    md::DynamicsSettings { time_step, thermostat, cell_motion, stream, skin: settings.skin }
}
