//! The frames of a trajectory.

use std::fs::File;
use std::path::{Path, PathBuf};

use atoms::extxyz::{Column, Frame, FrameLabels, LabelKeys, write_frame};
use atoms::units::ACCELERATION;
use md::Dynamics;

use crate::atomic_file::{cannot_create, cannot_write};
use crate::cli::CommandError;

/// A trajectory file, valid after every frame.
pub struct Trajectory {
    path: PathBuf,
    file: File,
    /// Number of frames written.
    pub frames: u64,
    last_step: Option<u64>,
}

impl Trajectory {
    /// Creates the file; an existing one is replaced.
    pub fn create(path: &Path) -> Result<Self, CommandError> {
        let file = File::create(path).map_err(|error| cannot_create(path, error))?;
        Ok(Self { path: path.to_owned(), file, frames: 0, last_step: None })
    }

    /// Appends the current step, unless it is already the last frame.
    pub fn push(&mut self, dynamics: &Dynamics) -> Result<(), CommandError> {
        let step = dynamics.state().step;
        if self.last_step != Some(step) {
            write_frame(&mut self.file, &frame(dynamics)).map_err(|error| cannot_write(&self.path, error))?;
            self.frames += 1;
            self.last_step = Some(step);
        }
        Ok(())
    }
}

/// Energy (eV), forces (eV/Å), stress (eV/Å³, without its kinetic part), step, time (fs), temperature (K) and momenta.
fn frame(dynamics: &Dynamics) -> Frame {
    let (state, evaluation) = (dynamics.state(), dynamics.evaluation());
    let labels = FrameLabels {
        energy: Some(evaluation.energy()),
        forces: Some(evaluation.forces.clone()),
        stress: evaluation.stress(&state.structure),
    };
    // The unit of momentum of ASE is u Å per Å √(u/eV); 1 fs is √ACCELERATION of this unit of time, with the acceleration of 1
    // u by 1 eV/Å.
    let unit = ACCELERATION.sqrt();
    let momenta = state.velocities.iter().zip(dynamics.masses());
    let momenta: Vec<_> = momenta.map(|(v, mass)| v.map(|v| mass * v / unit)).collect();
    let mut frame = Frame::from(state.structure.clone());
    frame.set_labels(&labels, LabelKeys::Ase);
    frame.arrays.insert("momenta".into(), Column::vectors(&momenta));
    frame.info.insert("step".into(), i64::try_from(state.step).unwrap_or(i64::MAX).into());
    frame.info.insert("time_fs".into(), time(dynamics).into());
    frame.info.insert("temperature".into(), dynamics.temperature().into());
    frame
}

/// fs.
pub fn time(dynamics: &Dynamics) -> f64 {
    dynamics.state().step as f64 * dynamics.checkpoint().time_step
}
