//! The integrator.

use atoms::cell::{add, scale};
use atoms::units::ACCELERATION;
use atoms::{Evaluation, NeighbourList, Potential, Species, Structure};

use crate::checkpoint::Checkpoint;
use crate::error::DynamicsError;
use crate::random::Stream;
use crate::state::{self, State};
use crate::thermostat::Thermostat;
use crate::volume_ramp::VolumeRamp;

/// The settings of a run, apart from its initial state.
#[derive(Clone, Debug, PartialEq)]
pub struct DynamicsSettings {
    /// Time step, fs; see [`default_time_step`].
    pub time_step: f64,
    /// The thermostat.
    pub thermostat: Thermostat,
    /// The volume ramp, if any.
    pub ramp: Option<VolumeRamp>,
    /// The random stream.
    pub stream: Stream,
    /// Skin of the neighbour list, Å; does not affect the results.
    pub skin: f64,
}

/// A running simulation.
///
/// Velocity Verlet (Swope et al., J. Chem. Phys. 76, 637 (1982)), optionally with a Nosé–Hoover chain, or BAOAB
/// with Langevin. The volume ramp acts between drift and evaluation, so each step has one evaluation.
#[derive(Clone, Debug)]
pub struct Dynamics {
    now: Checkpoint,
    masses: Vec<f64>,
    neighbours: NeighbourList,
}

impl Dynamics {
    /// Starts a run with one evaluation of `potential`.
    ///
    /// # Errors
    /// If state or settings are invalid or the potential cannot evaluate the structure.
    pub fn new(
        state: State,
        settings: DynamicsSettings,
        potential: &mut dyn Potential,
    ) -> Result<Self, DynamicsError> {
        let mut evaluation = Evaluation::default();
        evaluation.reset(state.structure.len());
        let DynamicsSettings { time_step, thermostat, ramp, stream, skin } = settings;
        let start = Checkpoint { state, evaluation, thermostat, ramp, time_step, stream };
        let mut dynamics = Self::resume(start, potential.cutoff(), skin)?;
        dynamics.evaluate(potential)?;
        Ok(dynamics)
    }

    /// Resumes from a checkpoint without an evaluation. `cutoff` of the potential and `skin` in Å.
    ///
    /// # Errors
    /// If the checkpoint is inconsistent, see [`Checkpoint::validate`].
    pub fn resume(checkpoint: Checkpoint, cutoff: f64, skin: f64) -> Result<Self, DynamicsError> {
        checkpoint.validate()?;
        let masses = state::masses(&checkpoint.state.structure.species);
        let mut neighbours = NeighbourList::new(cutoff, skin);
        neighbours.update(&checkpoint.state.structure)?;
        Ok(Self { now: checkpoint, masses, neighbours })
    }

    /// Makes one step with one evaluation of `potential`.
    ///
    /// # Errors
    /// If the structure or the forces became invalid. The state is then between two steps.
    pub fn step(&mut self, potential: &mut dyn Potential) -> Result<(), DynamicsError> {
        let half = 0.5 * self.now.time_step;
        self.thermostat_half_step();
        self.kick(half);
        self.drift(half);
        let Checkpoint { state, stream, time_step, thermostat, .. } = &mut self.now;
        thermostat.exchange(&mut state.velocities, &self.masses, *time_step, stream, state.step);
        self.drift(half);
        if let Some(ramp) = self.now.ramp {
            ramp.apply(&mut self.now.state.structure, self.now.state.step + 1);
        }
        self.evaluate(potential)?;
        self.kick(half);
        self.thermostat_half_step();
        self.now.state.step += 1;
        Ok(())
    }

    /// The state from which the run can resume.
    pub fn checkpoint(&self) -> &Checkpoint {
        &self.now
    }

    /// Structure, velocities and step.
    pub fn state(&self) -> &State {
        &self.now.state
    }

    /// The structure.
    pub fn structure(&self) -> &Structure {
        &self.now.state.structure
    }

    /// Energies, forces and virial at the structure.
    pub fn evaluation(&self) -> &Evaluation {
        &self.now.evaluation
    }

    /// The neighbour list, valid for the structure.
    pub fn neighbours(&self) -> &NeighbourList {
        &self.neighbours
    }

    /// Masses, `[n]`, u.
    pub fn masses(&self) -> &[f64] {
        &self.masses
    }

    /// Kinetic energy, eV.
    pub fn kinetic_energy(&self) -> f64 {
        state::kinetic_energy(&self.now.state.velocities, &self.masses)
    }

    /// Degrees of freedom of the kinetic energy for this thermostat.
    pub fn degrees_of_freedom(&self) -> usize {
        self.now.thermostat.degrees_of_freedom(self.masses.len())
    }

    /// Kinetic temperature, K.
    pub fn temperature(&self) -> f64 {
        state::temperature(self.kinetic_energy(), self.degrees_of_freedom())
    }

    /// The quantity conserved without a volume ramp, eV: K + E plus the energy of a Nosé–Hoover chain; `None`
    /// with Langevin.
    pub fn conserved_energy(&self) -> Option<f64> {
        let thermostat = self.now.thermostat.energy(self.degrees_of_freedom())?;
        Some(self.kinetic_energy() + self.now.evaluation.energy() + thermostat)
    }

    fn thermostat_half_step(&mut self) {
        let Checkpoint { state, thermostat, time_step, .. } = &mut self.now;
        thermostat.half_step(&mut state.velocities, &self.masses, *time_step);
    }

    /// v += F / m · time
    fn kick(&mut self, time: f64) {
        let forces = self.now.evaluation.forces.iter().zip(&self.masses);
        for (v, (force, mass)) in self.now.state.velocities.iter_mut().zip(forces) {
            *v = add(*v, scale(*force, ACCELERATION * time / mass));
        }
    }

    /// r += v · time
    fn drift(&mut self, time: f64) {
        let state = &mut self.now.state;
        for (r, v) in state.structure.positions.iter_mut().zip(&state.velocities) {
            *r = add(*r, scale(*v, time));
        }
    }

    fn evaluate(&mut self, potential: &mut dyn Potential) -> Result<(), DynamicsError> {
        let Checkpoint { state, evaluation, .. } = &mut self.now;
        self.neighbours.update(&state.structure)?;
        potential.evaluate(&state.structure, &self.neighbours, evaluation)?;
        let finite = |x: &f64| x.is_finite();
        let mut results = evaluation.forces.iter().zip(&evaluation.atomic_energies);
        match results.position(|(force, energy)| !(force.iter().all(finite) && energy.is_finite())) {
            Some(atom) => Err(DynamicsError::NotFinite { atom, step: state.step }),
            None => Ok(()),
        }
    }
}

/// 2 fs, or 0.5 fs with H, He, Li or Be (paper, "Foundation-model expansion").
pub fn default_time_step(species: &[Species]) -> f64 {
    if species.iter().any(|species| species.atomic_number() <= 4) { 0.5 } else { 2.0 }
}
