//! Relaxation of positions.

use atoms::cell::{add, dot, norm, scale};
use atoms::{Evaluation, NeighbourList, Potential, Structure, Vec3};

use crate::error::DynamicsError;

/// Relaxes positions at fixed cell by the fast inertial relaxation engine, FIRE: Bitzek et al., Phys. Rev. Lett. 97, 170201 (2006),
/// with unit masses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fire {
    /// The largest force at which it ends, eV/Å.
    pub max_force: f64,
    /// The number of steps after which it ends anyway.
    pub max_steps: usize,
}

/// A relaxed structure.
#[derive(Clone, Debug, PartialEq)]
pub struct Relaxed {
    /// The structure; its cell did not change.
    pub structure: Structure,
    /// Energies, forces and virial.
    pub evaluation: Evaluation,
    /// Steps made.
    pub steps: usize,
    /// Whether the largest force is small enough.
    pub is_converged: bool,
}

impl Default for Fire {
    fn default() -> Self {
        Self { max_force: 0.01, max_steps: 500 }
    }
}

// Parameters of the paper. With unit masses, time is in Å/√eV.
const FIRST_STEP: f64 = 0.1;
const LARGEST_STEP: f64 = 1.0;
const STEPS_BEFORE_ACCELERATION: usize = 5;
const ACCELERATION: f64 = 1.1;
const DECELERATION: f64 = 0.5;
const MIXING: f64 = 0.1;
const LESS_MIXING: f64 = 0.99;
/// Longest way of an atom in a step, Å.
const REACH: f64 = 0.1;
/// Skin of the neighbour list, Å.
const SKIN: f64 = 0.4;

impl Fire {
    /// Relaxes `structure`. Ends early, unconverged, when `stop` returns true.
    ///
    /// # Errors
    /// A structure that the potential cannot evaluate, or forces that are not finite.
    pub fn relax(
        &self,
        structure: Structure,
        potential: &mut dyn Potential,
        stop: &dyn Fn() -> bool,
    ) -> Result<Relaxed, DynamicsError> {
        let mut neighbours = NeighbourList::new(potential.cutoff(), SKIN);
        let (evaluation, steps) = (Evaluation::default(), 0);
        let mut now = Relaxed { structure, evaluation, steps, is_converged: false };
        now.evaluate(potential, &mut neighbours)?;
        let mut velocities = vec![[0.0; 3]; now.structure.len()];
        let (mut time_step, mut mixing, mut downhill) = (FIRST_STEP, MIXING, 0);
        while now.largest_force() > self.max_force && now.steps < self.max_steps && !stop() {
            let forces = &now.evaluation.forces;
            if product(forces, &velocities) > 0.0 {
                downhill += 1;
                if downhill > STEPS_BEFORE_ACCELERATION {
                    time_step = f64::min(time_step * ACCELERATION, LARGEST_STEP);
                    mixing *= LESS_MIXING;
                }
            } else {
                (time_step, mixing, downhill) = (time_step * DECELERATION, MIXING, 0);
                velocities.fill([0.0; 3]);
            }
            for (v, force) in velocities.iter_mut().zip(forces) {
                *v = add(*v, scale(*force, time_step));
            }
            let along = mixing * (product(&velocities, &velocities) / product(forces, forces)).sqrt();
            let mut longest: f64 = 0.0;
            for (v, force) in velocities.iter_mut().zip(forces) {
                *v = add(scale(*v, 1.0 - mixing), scale(*force, along));
                longest = longest.max(norm(*v) * time_step);
            }
            let way = time_step * (REACH / longest).min(1.0);
            for (r, v) in now.structure.positions.iter_mut().zip(&velocities) {
                *r = add(*r, scale(*v, way));
            }
            now.steps += 1;
            now.evaluate(potential, &mut neighbours)?;
        }
        now.is_converged = now.largest_force() <= self.max_force;
        Ok(now)
    }
}

impl Relaxed {
    /// The largest force, eV/Å.
    pub fn largest_force(&self) -> f64 {
        self.evaluation.forces.iter().map(|force| norm(*force)).fold(0.0, f64::max)
    }

    fn evaluate(
        &mut self,
        potential: &mut dyn Potential,
        neighbours: &mut NeighbourList,
    ) -> Result<(), DynamicsError> {
        neighbours.update(&self.structure)?;
        potential.evaluate(&self.structure, neighbours, &mut self.evaluation)?;
        let Evaluation { forces, atomic_energies, .. } = &self.evaluation;
        let is_finite = |(force, energy): (&Vec3, &f64)| force.iter().chain([energy]).all(|x| x.is_finite());
        match forces.iter().zip(atomic_energies).position(|atom| !is_finite(atom)) {
            Some(atom) => Err(DynamicsError::NotFinite { atom, step: self.steps as u64 }),
            None => Ok(()),
        }
    }
}

fn product(a: &[Vec3], b: &[Vec3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| dot(*a, *b)).sum()
}
