//! The initial state of a walk.

use atoms::{NeighbourList, Potential, ShortestDistances};
use md::Dynamics;
use wire::Origin;
use wire::messages::Assignment;

use super::constant_pressure::{cell_bias, start_reference_run};
use super::error::WalkError;
use super::initial_dynamics::start_dynamics;
use super::state::{ReferenceRun, WalkState};
use crate::bias::{BiasState, BiasedPotential};
use crate::settings::WalkSettings;

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
    let first = ReferenceRun { volumes: 0.0, assignment: assignment.number, until: assignment.last_step };
    let reference_run = reference.as_ref().map(|_| first);
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
        collected: 0,
        collection_points: Vec::new(),
        min_distances,
        good: Vec::new(),
        gamma_max: 0.0,
        trace_points: 0,
    };
    state.keep_checkpoint(&dynamics, potential);
    Ok((dynamics, state))
}
