//! Walks at constant pressure: the reference run that gives V₀, the start at a volume relative to it, and the release
//! of the cell after equilibration.

use atoms::Structure;
use md::{CellMotion, Dynamics, Stream};
use wire::messages::{Assignment, Outcome, WalkProgress};
use wire::{Candidate, ConstantPressure, ContentHash, Origin};

use super::initial_dynamics::{run_settings, start_dynamics};
use super::state::WalkState;
use super::{RunningWalk, WalkError};
use crate::bias::BiasedPotential;
use crate::cell_bias::CellBias;
use crate::settings::WalkSettings;

/// Segment of the random numbers of reference runs. Those of walks count from 0.
const REFERENCE_SEGMENT: u32 = u32::MAX;

/// Starts the reference run of a walk that has one.
pub(super) fn start_reference_run(
    settings: &WalkSettings,
    assignment: &Assignment,
    potential: &mut BiasedPotential,
) -> Result<Option<Dynamics>, WalkError> {
    let Some(constant) = assignment.conditions.constant_pressure().filter(|_| settings.reference_steps > 0)
    else {
        return Ok(None);
    };
    let structure = assignment.seed_structure.clone();
    let [first, second, third, fourth, ..] = ContentHash::from_structure(&structure).0;
    let seed = u32::from_le_bytes([first, second, third, fourth]);
    let stream = Stream::new(settings.rng_seed, seed, REFERENCE_SEGMENT);
    let start = md::State::thermal(structure, assignment.conditions.temperature, &stream);
    let motion = barostat(settings, assignment, constant, &start.structure, None);
    let run = run_settings(settings, assignment, motion, stream);
    Ok(Some(Dynamics::new(start, run, potential)?))
}

/// A barostat at rest. `reference_volume` V₀ limits the volume of a biased cell.
fn barostat(
    settings: &WalkSettings,
    assignment: &Assignment,
    constant: ConstantPressure,
    structure: &Structure,
    reference_volume: Option<f64>,
) -> CellMotion {
    let temperature = assignment.conditions.temperature;
    let thermostat = settings.thermostat.start(temperature);
    let keys = md::BarostatSettings { pressure: constant.pressure, ..settings.barostat };
    let mut barostat = keys.start(temperature, &thermostat, structure);
    if let Some(volume) = reference_volume {
        barostat.reference_volume = volume;
        let biased = constant.cell_bias && assignment.origin == Origin::Biased;
        barostat.volume_range = biased.then(|| settings.cell_bias.volume_range.map(|ratio| ratio * volume));
    }
    CellMotion::from(barostat)
}

/// The bias on the cell of a walk that has one, at its start.
pub(super) fn cell_bias(
    settings: &WalkSettings,
    assignment: &Assignment,
    potential: &mut BiasedPotential,
) -> Result<Option<CellBias>, WalkError> {
    let is_biased = assignment.conditions.constant_pressure().is_some_and(|constant| constant.cell_bias);
    if !is_biased || assignment.origin == Origin::Control {
        return Ok(None);
    }
    let stress_scale = match settings.cell_bias.stress_scale {
        Some(given) => given,
        None => md::bulk_modulus(&assignment.seed_structure, potential)?,
    };
    if stress_scale > 0.0 {
        return Ok(Some(CellBias::new(&settings.cell_bias, stress_scale)));
    }
    Err(WalkError::BulkModulus(stress_scale * atoms::units::GPA_PER_EV_A3))
}

impl RunningWalk<'_> {
    /// Runs what is left of the reference run, at most as many steps as the assignment has, and puts the walk at its start. An
    /// assignment that was interrupted goes on to the same step.
    pub(super) fn finish_reference_run(
        &mut self,
        stopping: &impl Fn() -> bool,
        on_progress: &impl Fn(WalkProgress),
    ) -> Result<Option<Outcome<Candidate>>, WalkError> {
        let steps = self.settings.reference_steps;
        let (number, begun) = (self.assignment.number, self.dynamics.state().step);
        if let Some(run) = self.state.reference_run.as_mut().filter(|run| run.assignment != number) {
            (run.assignment, run.until) = (number, begun.saturating_add(self.assignment.last_step));
        }
        while let Some(mut run) = self.state.reference_run {
            let step = self.dynamics.state().step;
            if step >= steps {
                let volume = run.volumes / (steps - steps / 2) as f64;
                self.start_from_reference(volume)?;
                break;
            }
            if step >= run.until {
                return Ok(Some(Outcome::StepsDone));
            }
            if stopping() {
                return Ok(Some(Outcome::Interrupted));
            }
            self.potential.tau = 0.0;
            self.dynamics.step(&mut self.potential)?;
            self.check_step()?;
            if step >= steps / 2 {
                run.volumes += md::extent(self.dynamics.structure());
            }
            self.state.reference_run = Some(run);
            on_progress(self.progress());
        }
        Ok(None)
    }

    fn start_from_reference(&mut self, volume: f64) -> Result<(), WalkError> {
        let structure = self.dynamics.structure().clone();
        self.dynamics =
            start_dynamics(self.settings, self.assignment, structure, volume, &mut self.potential)?;
        self.state.reference_run = None;
        self.state.reference_volume = volume;
        self.state.good = vec![self.state.good_state(&self.dynamics, &self.potential)];
        self.trace_if_due()
    }

    /// Lets a barostat move the cell from the first step after equilibration on.
    pub(super) fn release_cell(&mut self) -> Result<(), WalkError> {
        let Some(constant) = self.assignment.conditions.constant_pressure() else { return Ok(()) };
        if *self.cell_motion() == CellMotion::Fixed {
            let volume = Some(self.state.reference_volume);
            let structure = self.dynamics.structure();
            let motion = barostat(self.settings, self.assignment, constant, structure, volume);
            self.dynamics.set_cell_motion(motion)?;
        }
        Ok(())
    }

    /// Step of the reference run, as long as it lasts.
    pub(super) fn reference_step(&self) -> Option<u64> {
        self.state.reference_run.as_ref().map(|_| self.dynamics.state().step)
    }

    /// V₀ of a walk at constant pressure, once it is known.
    pub(super) fn reference_volume(&self) -> Option<f64> {
        let is_known =
            self.assignment.conditions.constant_pressure().is_some() && self.state.reference_run.is_none();
        is_known.then_some(self.state.reference_volume)
    }

    /// Where the walk is, for the reason of its end: `at step 12`.
    pub(super) fn place(&self) -> String {
        match self.state.reference_run {
            Some(_) => format!("at step {} of the reference run", self.dynamics.state().step),
            None => format!("at step {}", self.step()),
        }
    }

    /// Takes note of the volume after a step with a biased cell.
    pub(super) fn observe_cell(&mut self, reflections_before: u64) {
        let (step, volume) = (self.step(), self.relative_volume());
        let reflections = self.reflections();
        let Some(bias) = &mut self.state.cell_bias else { return };
        bias.observe(&self.settings.cell_bias, volume);
        if reflections > reflections_before {
            bias.touch(&self.settings.cell_bias, step);
        }
    }

    /// Reflections at a boundary of the volume so far.
    pub(super) fn reflections(&self) -> u64 {
        self.dynamics.barostat().map_or(0, |barostat| barostat.reflections)
    }

    /// Whether the walk has collected enough and touches a boundary of its volume again and again.
    pub(super) fn is_at_volume_boundary(&self) -> bool {
        let WalkState { cell_bias, collected, .. } = &self.state;
        let step = self.step();
        cell_bias.as_ref().is_some_and(|bias| bias.ends(&self.settings.cell_bias, step, *collected))
    }

    fn cell_motion(&self) -> &CellMotion {
        &self.dynamics.checkpoint().cell_motion
    }
}
