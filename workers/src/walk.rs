//! Runs one assignment of a walk: a function from an assignment to a report, without state.
//!
//! Everything that a walk remembers is in its [checkpoint](WalkState), so the same assignment gives the same
//! report, on any walker and any number of times.

mod candidate;
mod constant_pressure;
mod error;
mod initial_dynamics;
mod start;
mod state;
mod step_view;
mod trace;
mod trajectory;
mod update_work;

use std::sync::Arc;

use atoms::ShortestDistances;
use calm::{CollectionRule, Mixture};
use md::{Dynamics, Stream};
use potentials::grace::Threads;
use potentials::{ModelWithFeatures, Wall, Zbl};
use wire::messages::{
    Assignment, AssignmentReport, AssignmentStart, Outcome, Verdict, WalkEnd, WalkProgress,
};
use wire::{Candidate, Origin, TracePoint, WalkFrame};

use crate::bias::{BiasedPotential, UngradedError};
use crate::cell_bias::CellBias;
use crate::guard;
use crate::settings::WalkSettings;
use error::WalkError;
use start::start;
use state::{GoodState, WalkState};
pub use state::{has_known_layout, is_same_state};
pub use step_view::StepView;

/// Data shared by every walk of a campaign.
#[derive(Clone)]
pub struct WalkContext {
    /// The model.
    pub model: Arc<dyn ModelWithFeatures>,
    /// The threads that evaluate the model.
    pub threads: Threads,
    /// The settings.
    pub settings: Arc<WalkSettings>,
    /// The original mixture of the walks' version of the potential, for their traces.
    pub original: Arc<Mixture>,
}

/// Runs an assignment until it ends: with a candidate, at its last step, with the end of the walk, or when
/// `stopping` returns true. Calls `on_progress` with the progress after each step.
///
/// # Errors
/// The program that evaluates the potential does not answer any more. The assignment is as it was: another walker may run it.
pub fn advance(
    context: &WalkContext,
    assignment: &Assignment,
    mixture: Arc<Mixture>,
    stopping: impl Fn() -> bool,
    on_progress: impl Fn(WalkProgress),
) -> Result<AssignmentReport<Candidate>, PotentialUnavailable> {
    advance_observed(context, assignment, mixture, stopping, on_progress, |_| ())
}

/// Like [`advance`], and calls `on_step` at the start of the walk and after each of its steps.
///
/// # Errors
/// See [`advance`].
pub fn advance_observed(
    context: &WalkContext,
    assignment: &Assignment,
    mixture: Arc<Mixture>,
    stopping: impl Fn() -> bool,
    on_progress: impl Fn(WalkProgress),
    mut on_step: impl FnMut(&mut StepView<'_, '_>),
) -> Result<AssignmentReport<Candidate>, PotentialUnavailable> {
    let mut running = match RunningWalk::start_or_resume(context, assignment, mixture) {
        Ok(running) => running,
        Err(WalkError::Unavailable(reason)) => return Err(PotentialUnavailable(reason)),
        Err(error) => return Ok(without_a_step(assignment, error.to_string())),
    };
    let start = AssignmentStart {
        position: running.progress().position(),
        mixture_version: running.mixture_version,
        threshold_factor: assignment.threshold_factor,
        verdict: assignment.verdict.clone(),
    };
    let outcome = match running.run(&stopping, &on_progress, &mut on_step) {
        Ok(outcome) => outcome,
        Err(WalkError::Unavailable(reason)) => return Err(PotentialUnavailable(reason)),
        Err(error) => Outcome::Ended(WalkEnd::Diverged { reason: format!("{}: {error}", running.place()) }),
    };
    Ok(AssignmentReport {
        walk: assignment.walk,
        assignment: assignment.number,
        start: Some(start),
        outcome,
        checkpoint: running.encode(),
        progress: running.progress(),
        trace: running.take_trace(),
        frames: running.frames,
    })
}

/// The report on a walk that ends before it makes a step, at its start or at its checkpoint, and why.
pub(crate) fn without_a_step(assignment: &Assignment, reason: String) -> AssignmentReport<Candidate> {
    let end = match assignment.checkpoint {
        None => WalkEnd::InvalidStart { reason },
        Some(_) => WalkEnd::Diverged { reason },
    };
    AssignmentReport {
        walk: assignment.walk,
        assignment: assignment.number,
        start: None,
        outcome: Outcome::Ended(end),
        checkpoint: assignment.checkpoint.clone().unwrap_or_default(),
        progress: WalkProgress::default(),
        trace: Vec::new(),
        frames: Vec::new(),
    }
}

/// The program that evaluates the potential does not answer any more.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct PotentialUnavailable(pub String);

/// A walk during an assignment.
struct RunningWalk<'a> {
    settings: &'a WalkSettings,
    assignment: &'a Assignment,
    model: &'a dyn ModelWithFeatures,
    mixture_version: u64,
    /// The collection rule of this assignment.
    collection: CollectionRule,
    dynamics: Dynamics,
    potential: BiasedPotential,
    original: &'a Mixture,
    state: WalkState,
    trace: Vec<TracePoint>,
    frames: Vec<WalkFrame>,
}

impl<'a> RunningWalk<'a> {
    fn start_or_resume(
        context: &'a WalkContext,
        assignment: &'a Assignment,
        mixture: Arc<Mixture>,
    ) -> Result<Self, WalkError> {
        let WalkContext { model, threads, settings, original } = context;
        let species = &assignment.seed_structure.species;
        let zbl = settings.zbl.as_ref().map(|windows| Zbl::new(species, windows)).transpose()?;
        let mixture_version = mixture.version();
        let bias_averaging_steps = settings.bias_averaging_steps;
        let evaluator = Arc::clone(model).evaluator(threads.clone());
        let mut potential = BiasedPotential::new(evaluator, mixture, zbl, bias_averaging_steps, species)?;
        let cluster = Some(&assignment.seed_structure).filter(|seed| seed.periodic == [false; 3]);
        potential.wall = cluster.zip(settings.wall).map(|(cluster, wall)| Wall::around(cluster, &wall));
        let (dynamics, state) = match &assignment.checkpoint {
            None => start(settings, assignment, &mut potential)?,
            Some(bytes) => {
                let state: WalkState = WalkState::decode(bytes)?;
                let cutoff = atoms::Potential::cutoff(&potential);
                (Dynamics::resume(state.dynamics.clone(), cutoff, settings.skin)?, state)
            }
        };
        potential.state = state.bias;
        if assignment.conditions.constant_pressure().is_none() {
            potential.norm_interval = settings.bias_norm_interval;
        }
        let collection = settings.collection.with_threshold_factor(assignment.threshold_factor);
        Ok(Self {
            settings,
            assignment,
            model: &**model,
            mixture_version,
            collection,
            dynamics,
            potential,
            original,
            state,
            trace: Vec::new(),
            frames: Vec::new(),
        })
    }

    /// What comes before the first step of an assignment.
    fn begin(&mut self) -> Result<(), WalkError> {
        self.apply_verdict();
        self.remove_update_work()?;
        if self.assignment.checkpoint.is_none() {
            self.trace_if_due()?;
        }
        Ok(())
    }

    /// Sets the earliest step of the next candidate: after a collection the walk waits out the full interval, after
    /// a decline a shorter one.
    fn apply_verdict(&mut self) {
        let step = self.step();
        match &self.assignment.verdict {
            None => {}
            Some(Verdict::Accepted) => {
                self.state.collect(step, self.settings);
                self.state.next_offer = step + self.settings.min_interval;
            }
            Some(Verdict::Declined(_)) => {
                self.state.next_offer = step + self.settings.min_interval_after_decline
            }
        }
    }

    fn run(
        &mut self,
        stopping: &impl Fn() -> bool,
        on_progress: &impl Fn(WalkProgress),
        on_step: &mut impl FnMut(&mut StepView<'_, '_>),
    ) -> Result<Outcome<Candidate>, WalkError> {
        let begins = self.assignment.checkpoint.is_none() || self.state.reference_run.is_some();
        self.begin()?;
        if let Some(interrupted) = self.finish_reference_run(stopping, on_progress)? {
            return Ok(interrupted);
        }
        if begins {
            self.add_frame_if_due();
            on_step(&mut StepView { walk: self });
        }
        let last = self.settings.equilibration_steps + self.settings.biased_steps;
        loop {
            if self.is_at_volume_boundary() {
                return Ok(Outcome::Ended(WalkEnd::VolumeBoundary));
            }
            if self.step() >= last {
                return Ok(Outcome::Ended(WalkEnd::Completed));
            }
            if self.step() >= self.assignment.last_step {
                return Ok(Outcome::StepsDone);
            }
            if stopping() || self.frames_are_full() {
                return Ok(Outcome::Interrupted);
            }
            self.advance_one_step()?;
            self.trace_step()?;
            self.add_frame_if_due();
            on_step(&mut StepView { walk: self });
            if let Some(outcome) = self.inspect_step()? {
                return Ok(outcome);
            }
            on_progress(self.progress());
        }
    }

    /// Steps since the start of the walk, to which a reference run does not belong.
    fn step(&self) -> u64 {
        if self.state.reference_run.is_some() { 0 } else { self.dynamics.state().step }
    }

    fn is_control(&self) -> bool {
        self.assignment.origin == Origin::Control
    }

    fn advance_one_step(&mut self) -> Result<(), WalkError> {
        let equilibrated = self.step() >= self.settings.equilibration_steps;
        self.potential.tau = if equilibrated { self.state.tau } else { 0.0 };
        if equilibrated {
            self.release_cell()?;
        }
        let stress = self.state.cell_bias.as_ref().map_or(0.0, CellBias::stress);
        let reflections = self.reflections();
        self.dynamics.step_with_bias_stress(&mut self.potential, |bias, _| bias.cell_stress(stress))?;
        if equilibrated {
            self.observe_cell(reflections);
        }
        self.state.bias_sum = self.bias_sum();
        self.check_step()
    }

    fn check_step(&self) -> Result<(), WalkError> {
        let (structure, neighbours) = (self.dynamics.structure(), self.dynamics.neighbours());
        let (evaluation, temperature) = (self.dynamics.evaluation(), self.dynamics.temperature());
        match guard::blown_up(&self.settings.guard, structure, neighbours, evaluation, temperature) {
            Some(reason) => Err(WalkError::Diverged(reason)),
            None => Ok(()),
        }
    }

    /// Evaluates the new step: a requested frame, a candidate, a refusal by the guard, or nothing.
    fn inspect_step(&mut self) -> Result<Option<Outcome<Candidate>>, WalkError> {
        let step = self.step();
        if self.is_control() {
            let wanted = self.assignment.frame_steps.contains(&step);
            return if wanted { Ok(Some(Outcome::Candidate(self.candidate()?))) } else { Ok(None) };
        }
        let biased_steps = step.checked_sub(self.settings.equilibration_steps);
        let Some(biased_steps) = biased_steps else { return Ok(None) };
        let too_close = self.is_too_close();
        if biased_steps % self.settings.guard.checkpoint_interval == 0 && !too_close {
            if biased_steps == 0 {
                // The start of the walk needs equilibration, so from here on it is no target for a roll back.
                self.state.good.clear();
            }
            self.save_checkpoint();
        }
        if biased_steps == 0 {
            return Ok(None);
        }
        let gamma = gamma(&mut self.potential, &self.dynamics)?;
        self.state.gamma_max = calm::grade::maximum(gamma);
        let collects = step >= self.state.next_offer && self.collection.is_met(gamma);
        if !collects {
            return Ok(None);
        }
        if too_close {
            return self.record_refusal(guard::SHORTEST_BOND);
        }
        if self.settings.guard.max_grade.is_some_and(|bound| self.state.gamma_max > bound) {
            return self.record_refusal(guard::LARGEST_GRADE);
        }
        self.state.max_consecutive_rejections = 0;
        Ok(Some(Outcome::Candidate(self.candidate()?)))
    }

    fn is_too_close(&self) -> bool {
        let shortest =
            ShortestDistances::from_neighbours(self.dynamics.structure(), self.dynamics.neighbours());
        self.state.min_distances.violation(&shortest).is_some()
    }

    fn save_checkpoint(&mut self) {
        self.state.keep_checkpoint(&self.dynamics, &self.potential);
    }

    /// Counts a refusal by a guard. After too many in a row the walk rolls back, or ends.
    fn record_refusal(&mut self, by: &str) -> Result<Option<Outcome<Candidate>>, WalkError> {
        let guard = &self.settings.guard;
        self.state.rejected += 1;
        self.state.max_consecutive_rejections += 1;
        self.state.next_offer = self.step() + self.settings.min_interval_after_decline;
        if !guard.rollback || self.state.max_consecutive_rejections < guard.max_consecutive_rejections {
            return Ok(None);
        }
        if self.state.rollbacks == guard.max_rollbacks || self.state.good.is_empty() {
            return Ok(Some(Outcome::Ended(WalkEnd::Trapped { guard: by.to_owned() })));
        }
        self.roll_back()?;
        Ok(None)
    }

    /// Rolls back to the oldest good checkpoint as a new segment, with smaller τ and new random numbers.
    fn roll_back(&mut self) -> Result<(), WalkError> {
        let GoodState { dynamics: mut checkpoint, bias, cell_bias } = self.state.good.swap_remove(0);
        self.state.good.clear();
        self.state.segment += 1;
        self.state.rollbacks += 1;
        self.state.max_consecutive_rejections = 0;
        let factor = self.settings.guard.tau_factor;
        self.state.tau *= factor;
        checkpoint.stream = self.stream();
        let cutoff = self.dynamics.neighbours().cutoff();
        self.state.last_rollback = Some((self.step(), checkpoint.state.step));
        self.dynamics = Dynamics::resume(checkpoint, cutoff, self.settings.skin)?;
        self.potential.state = bias;
        self.state.cell_bias = cell_bias.map(|bias| bias.weakened(&self.settings.cell_bias, factor));
        self.state.bias_sum = None;
        self.state.next_offer = self.state.offer_after_rollback(self.step(), self.settings);
        self.save_checkpoint();
        Ok(())
    }

    /// Has the potential know forces and bias of the step apart.
    fn separate_bias(&mut self) -> Result<(), WalkError> {
        Ok(self.potential.separate(self.dynamics.structure(), self.dynamics.neighbours())?)
    }

    fn stream(&self) -> Stream {
        Stream::new(self.settings.rng_seed, self.assignment.random_walk.0, self.state.segment)
    }

    fn relative_volume(&self) -> f64 {
        let structure = self.dynamics.structure();
        if structure.periodic == [false; 3] {
            return 1.0;
        }
        if self.assignment.conditions.constant_pressure().is_some() {
            return md::extent(structure) / self.state.reference_volume;
        }
        let ramp = self.dynamics.checkpoint().cell_motion.ramp();
        ramp.map_or(1.0, |ramp| ramp.relative_volume(self.step()))
    }

    fn progress(&self) -> WalkProgress {
        WalkProgress {
            step: self.step(),
            segment: self.state.segment,
            tau: self.state.tau,
            temperature: self.dynamics.temperature(),
            relative_volume: self.relative_volume(),
            gamma_max: self.state.gamma_max,
            rejected: self.state.rejected,
            rollbacks: self.state.rollbacks,
            last_rollback: self.state.last_rollback,
            reference_step: self.reference_step(),
            reference_volume: self.reference_volume(),
        }
    }

    fn encode(&mut self) -> Vec<u8> {
        self.state.dynamics = self.dynamics.checkpoint().clone();
        self.state.bias = self.potential.state;
        self.state.encode()
    }
}

/// γ of each atom at the current step.
fn gamma<'a>(potential: &'a mut BiasedPotential, dynamics: &Dynamics) -> Result<&'a [f64], UngradedError> {
    Ok(&potential.grades(dynamics.structure(), dynamics.neighbours())?.gamma)
}
