//! A step of a trajectory, as a frame of either format.

use atoms::extxyz::{Column, Frame, FrameLabels, LabelKeys};
use atoms::lammps_dump::{DumpMotion, DumpSnapshot};
use atoms::units::ACCELERATION;
use atoms::{Evaluation, Structure, Vec3};
use md::Dynamics;

/// What a frame shows of a step.
pub struct TrajectoryStep<'a> {
    pub structure: &'a Structure,
    /// What the trajectories of the store do not have.
    pub motion: Option<StepMotion<'a>>,
    /// Segment of a walk.
    pub segment: Option<u32>,
    pub step: u64,
    /// fs.
    pub time: f64,
    /// K.
    pub temperature: f64,
    /// γ of each atom, if it is known.
    pub gamma: Option<&'a [f64]>,
}

/// How the atoms move, and why.
pub struct StepMotion<'a> {
    /// Å/fs.
    pub velocities: &'a [Vec3],
    /// u.
    pub masses: &'a [f64],
    /// Of the potential.
    pub evaluation: &'a Evaluation,
}

impl<'a> TrajectoryStep<'a> {
    /// The present step of a run.
    pub fn of_run(dynamics: &'a Dynamics) -> Self {
        let state = dynamics.state();
        Self {
            structure: &state.structure,
            motion: Some(StepMotion {
                velocities: &state.velocities,
                masses: dynamics.masses(),
                evaluation: dynamics.evaluation(),
            }),
            segment: None,
            step: state.step,
            time: state.step as f64 * dynamics.checkpoint().time_step,
            temperature: dynamics.temperature(),
            gamma: None,
        }
    }

    /// Step, time (fs) and temperature (K), and, if the motion is known, energy (eV), forces (eV/Å), stress (eV/Å³, without its kinetic
    /// part) and momenta.
    pub(super) fn frame(&self) -> Frame {
        let mut frame = Frame::from(self.structure.clone());
        if let Some(motion) = &self.motion {
            motion.add_to(&mut frame, self.structure);
        }
        if let Some(gamma) = self.gamma {
            frame.arrays.insert("gamma".into(), Column::scalars(gamma));
        }
        if let Some(segment) = self.segment {
            frame.info.insert("segment".into(), i64::from(segment).into());
        }
        frame.info.insert("step".into(), i64::try_from(self.step).unwrap_or(i64::MAX).into());
        frame.info.insert("time_fs".into(), self.time.into());
        frame.info.insert("temperature".into(), self.temperature.into());
        frame
    }

    pub(super) fn snapshot(&self) -> DumpSnapshot<'a> {
        DumpSnapshot {
            structure: self.structure,
            timestep: self.step,
            time: self.time,
            motion: self.motion.as_ref().map(|StepMotion { velocities, evaluation, .. }| DumpMotion {
                velocities,
                forces: &evaluation.forces,
            }),
            scalars: self.gamma.map(|gamma| ("c_gamma", gamma)).into_iter().collect(),
        }
    }
}

impl StepMotion<'_> {
    /// Adds energy, forces, stress and momenta.
    fn add_to(&self, frame: &mut Frame, structure: &Structure) {
        let labels = FrameLabels {
            energy: Some(self.evaluation.energy()),
            forces: Some(self.evaluation.forces.clone()),
            stress: self.evaluation.stress(structure),
        };
        // The unit of momentum of ASE is u Å per Å √(u/eV); 1 fs is √ACCELERATION of this unit of time, with the acceleration of 1
        // u by 1 eV/Å.
        let unit = ACCELERATION.sqrt();
        let momenta = self.velocities.iter().zip(self.masses);
        let momenta: Vec<_> = momenta.map(|(v, mass)| v.map(|v| mass * v / unit)).collect();
        frame.set_labels(&labels, LabelKeys::Ase);
        frame.arrays.insert("momenta".into(), Column::vectors(&momenta));
    }
}
