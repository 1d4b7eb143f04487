//! The dynamics with which a walk starts.

use atoms::Structure;
use md::{CellMotion, Dynamics, State, Stream, VolumeRamp};
use wire::messages::Assignment;

use super::error::WalkError;
use crate::bias::BiasedPotential;
use crate::settings::WalkSettings;

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
    let ramp = conditions.volume_ramp().map(|(from, to)| {
        let ramp = VolumeRamp::new(&start, from, to, settings.biased_steps);
        VolumeRamp { start: settings.equilibration_steps, ..ramp }
    });
    // Equilibration runs at the volume at which the ramp begins.
    if let Some(ramp) = ramp.filter(|ramp| ramp.from != 1.0) {
        ramp.apply(&mut start.structure, 0);
    }
    // Likewise, the barostat moves the cell only afterwards.
    if let Some(constant) = conditions.constant_pressure() {
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
