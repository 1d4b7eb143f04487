//! The integrator.

use atoms::cell::{add, scale};
use atoms::units::ACCELERATION;
use atoms::{Evaluation, Matrix3, NeighbourList, Potential, Species, Structure};

use crate::barostat::{Atoms, Barostat};
use crate::cell_freedom::CellFreedom;
use crate::cell_motion::CellMotion;
use crate::checkpoint::Checkpoint;
use crate::error::DynamicsError;
use crate::lattice_reduction::reduce_if_skew;
use crate::random::Stream;
use crate::state::{self, State};
use crate::strain_rate::{combined, transposed};
use crate::thermostat::Thermostat;

/// The settings of a run, apart from its initial state.
#[derive(Clone, Debug, PartialEq)]
pub struct DynamicsSettings {
    /// Time step, fs; see [`default_time_step`].
    pub time_step: f64,
    /// The thermostat.
    pub thermostat: Thermostat,
    /// How the cell moves.
    pub cell_motion: CellMotion,
    /// The random stream.
    pub stream: Stream,
    /// Skin of the neighbour list, Å; does not affect the results.
    pub skin: f64,
}

/// A running simulation.
///
/// Velocity Verlet (Swope et al., J. Chem. Phys. 76, 637 (1982)), optionally with a Nosé–Hoover chain, or BAOAB with
/// Langevin or velocity rescaling. A [`Barostat`] kicks the cell before the first and after the last kick of the atoms,
/// and stretches it with them. Volume ramps and volume ranges act between drift and evaluation, so each step has one
/// evaluation.
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
        let DynamicsSettings { time_step, thermostat, cell_motion, stream, skin } = settings;
        let start = Checkpoint { state, evaluation, thermostat, cell_motion, time_step, stream };
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

    /// Makes one step with one evaluation of `potential`. The bias stress of a barostat, if it has any, stays.
    ///
    /// # Errors
    /// If the structure, the forces or the cell became invalid. The state is then between two steps.
    pub fn step(&mut self, potential: &mut dyn Potential) -> Result<(), DynamicsError> {
        let stress = self.barostat().map(|barostat| barostat.bias_stress).unwrap_or_default();
        self.step_with_bias_stress(potential, |_, _| stress)
    }

    /// Makes one step with one evaluation of `potential`, after which `bias_stress` gives the stress (symmetric, eV/Å³,
    /// tension positive) that a barostat adds to that of the potential, from the next kick of the cell until the next
    /// evaluation. Without a barostat the stress has no effect.
    ///
    /// On a slab or wire it refers to the volume of the whole cell, as [`Evaluation::stress`] does.
    ///
    /// # Errors
    /// If the structure, the forces or the cell became invalid. The state is then between two steps.
    pub fn step_with_bias_stress<P: Potential + ?Sized>(
        &mut self,
        potential: &mut P,
        bias_stress: impl FnOnce(&mut P, &Structure) -> Matrix3,
    ) -> Result<(), DynamicsError> {
        let half = 0.5 * self.now.time_step;
        self.thermostat_half_step();
        self.kick_cell(half);
        self.kick(half);
        self.check_cell()?;
        self.drift(half);
        self.exchange();
        self.drift(half);
        self.finish_cell()?;
        self.evaluate(potential)?;
        self.set_bias_stress(|structure| bias_stress(potential, structure));
        self.kick(half);
        self.kick_cell(half);
        self.thermostat_half_step();
        self.now.state.step += 1;
        Ok(())
    }

    /// Keeps the volume within a range from the next step on: where it leaves it, the cell is rescaled onto the boundary
    /// and the isotropic part of its strain rate reversed. In Å³ (Å² for a slab, Å for a wire).
    ///
    /// # Errors
    /// Without a barostat, or with a range that is not positive and ascending.
    pub fn set_volume_range(&mut self, range: Option<[f64; 2]>) -> Result<(), DynamicsError> {
        let Some(barostat) = self.now.cell_motion.barostat_mut() else {
            return Err(DynamicsError::Barostat("only a barostat has a range of volumes"));
        };
        barostat.volume_range = range;
        self.now.validate()
    }

    /// Lets the cell move in another way from the next step on.
    ///
    /// # Errors
    /// The motion has impossible settings.
    pub fn set_cell_motion(&mut self, motion: CellMotion) -> Result<(), DynamicsError> {
        self.now.cell_motion = motion;
        self.now.validate()
    }

    /// Multiplies all velocities by a factor.
    pub fn scale_velocities(&mut self, factor: f64) {
        for velocity in &mut self.now.state.velocities {
            *velocity = scale(*velocity, factor);
        }
    }

    /// The state from which the run can resume.
    pub fn checkpoint(&self) -> &Checkpoint {
        &self.now
    }

    /// The barostat, if there is one.
    pub fn barostat(&self) -> Option<&Barostat> {
        self.now.cell_motion.barostat()
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

    /// P = (Σ m vᵀ v + virial) / V, eV/Å³, compression positive. For a slab or wire it refers to the whole cell
    /// including vacuum. `None` without periodic directions or if the lattice vectors do not span space.
    pub fn pressure_tensor(&self) -> Option<Matrix3> {
        let stress = self.now.evaluation.stress(&self.now.state.structure)?;
        let (volume, state) = (self.now.state.structure.cell.volume(), &self.now.state);
        let kinetic = state::kinetic_tensor(&state.velocities, &self.masses);
        Some(combined(&kinetic, &stress, |kinetic, stress| kinetic / volume - stress))
    }

    /// The conserved quantity, eV: K + E, plus the energies of chains and barostat, less the heat of velocity rescaling
    /// and the work of a bias on the cell; `None` with Langevin. Changes with a volume ramp, and where a barostat
    /// reflects.
    pub fn conserved_energy(&self) -> Option<f64> {
        let freedom = self.degrees_of_freedom();
        let thermostat = self.now.thermostat.energy(freedom)?;
        let cell = self.barostat().map_or(0.0, |barostat| barostat.energy(self.structure(), freedom));
        Some(self.kinetic_energy() + self.now.evaluation.energy() + thermostat + cell)
    }

    fn thermostat_half_step(&mut self) {
        let Checkpoint { state, thermostat, cell_motion, time_step, .. } = &mut self.now;
        thermostat.half_step(&mut state.velocities, &self.masses, *time_step);
        if let Some(barostat) = cell_motion.barostat_mut() {
            let atoms = atoms_of(thermostat, &self.masses);
            barostat.thermostat_half_step(&state.structure, &atoms, *time_step);
        }
    }

    fn kick_cell(&mut self, time: f64) {
        let Checkpoint { state, thermostat, cell_motion, evaluation, .. } = &mut self.now;
        if let Some(barostat) = cell_motion.barostat_mut() {
            let atoms = atoms_of(thermostat, &self.masses);
            barostat.kick_cell(&state.structure, &state.velocities, &evaluation.virial, &atoms, time);
        }
    }

    fn exchange(&mut self) {
        let Checkpoint { state, stream, time_step, thermostat, cell_motion, .. } = &mut self.now;
        thermostat.exchange(&mut state.velocities, &self.masses, *time_step, stream, state.step);
        if let Some(barostat) = cell_motion.barostat_mut() {
            let atoms = atoms_of(thermostat, &self.masses);
            barostat.exchange(&state.structure, &atoms, *time_step, stream, state.step);
        }
    }

    fn check_cell(&self) -> Result<(), DynamicsError> {
        let Checkpoint { state, time_step, .. } = &self.now;
        let check = |barostat: &Barostat| barostat.check_rate(&state.structure, *time_step, state.step + 1);
        self.barostat().map_or(Ok(()), check)
    }

    /// What happens to the cell between the last drift and the evaluation.
    fn finish_cell(&mut self) -> Result<(), DynamicsError> {
        let State { structure, step, .. } = &mut self.now.state;
        match &mut self.now.cell_motion {
            CellMotion::Fixed => {}
            CellMotion::VolumeRamp(ramp) => ramp.apply(structure, *step + 1),
            CellMotion::Barostat(barostat) => {
                barostat.limit_volume(structure, *step + 1)?;
                // At fixed angles the lattice vectors are those that keep their directions.
                if barostat.freedom == CellFreedom::Flexible {
                    reduce_if_skew(structure);
                }
            }
        }
        Ok(())
    }

    fn set_bias_stress(&mut self, bias_stress: impl FnOnce(&Structure) -> Matrix3) {
        if let Some(barostat) = self.now.cell_motion.barostat_mut() {
            let stress = bias_stress(&self.now.state.structure);
            barostat.bias_stress = combined(&stress, &transposed(&stress), |a, b| 0.5 * (a + b));
        }
    }

    /// v += F / m · time
    fn kick(&mut self, time: f64) {
        let Checkpoint { state, thermostat, cell_motion, evaluation, .. } = &mut self.now;
        if let Some(barostat) = cell_motion.barostat() {
            let atoms = atoms_of(thermostat, &self.masses);
            barostat.kick(&state.structure, &mut state.velocities, &evaluation.forces, &atoms, time);
            return;
        }
        let forces = evaluation.forces.iter().zip(&self.masses);
        for (v, (force, mass)) in state.velocities.iter_mut().zip(forces) {
            *v = add(*v, scale(*force, ACCELERATION * time / mass));
        }
    }

    /// r += v · time
    fn drift(&mut self, time: f64) {
        let Checkpoint { state, cell_motion, .. } = &mut self.now;
        if let Some(barostat) = cell_motion.barostat() {
            return barostat.drift(&mut state.structure, &state.velocities, time);
        }
        for (r, v) in state.structure.positions.iter_mut().zip(&state.velocities) {
            *r = add(*r, scale(*v, time));
        }
    }

    fn evaluate<P: Potential + ?Sized>(&mut self, potential: &mut P) -> Result<(), DynamicsError> {
        let Checkpoint { state, evaluation, .. } = &mut self.now;
        self.neighbours.update(&state.structure)?;
        potential.evaluate(&state.structure, &self.neighbours, evaluation)?;
        let finite = |x: &f64| x.is_finite();
        let mut results = evaluation.forces.iter().zip(&evaluation.atomic_energies);
        let broken = results.position(|(force, energy)| !(force.iter().all(finite) && energy.is_finite()));
        if let Some(atom) = broken {
            return Err(DynamicsError::NotFinite { atom, step: state.step });
        }
        if self.barostat().is_some() && !self.now.evaluation.virial.iter().flatten().all(finite) {
            return Err(DynamicsError::StressNotFinite { step: self.now.state.step });
        }
        Ok(())
    }
}

fn atoms_of<'a>(thermostat: &Thermostat, masses: &'a [f64]) -> Atoms<'a> {
    Atoms { masses, degrees_of_freedom: thermostat.degrees_of_freedom(masses.len()) }
}

/// 2 fs, or 0.5 fs with H, He, Li or Be (paper, "Foundation-model expansion").
pub fn default_time_step(species: &[Species]) -> f64 {
    if species.iter().any(|species| species.atomic_number() <= 4) { 0.5 } else { 2.0 }
}
