//! The frames of a trajectory.

use std::fs::File;
use std::path::{Path, PathBuf};

use atoms::extxyz::{Column, Frame, LabelKeys, Labels, write_frame};
use atoms::units::ACCELERATION;
use md::Dynamics;

use crate::cli::Failure;
use crate::whole_file::{cannot_create, cannot_write};

/// A trajectory that is being written: after every frame it is a valid file.
pub struct Trajectory {
    path: PathBuf,
    file: File,
    /// Frames so far.
    pub frames: u64,
    last_step: Option<u64>,
}

impl Trajectory {
    /// Begins it, in the place of a file that may be there.
    pub fn create(path: &Path) -> Result<Self, Failure> {
        let file = File::create(path).map_err(|error| cannot_create(path, error))?;
        Ok(Self { path: path.to_owned(), file, frames: 0, last_step: None })
    }

    /// Adds where the dynamics stand, unless that is the last frame already.
    pub fn push(&mut self, dynamics: &Dynamics) -> Result<(), Failure> {
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
    let labels = Labels {
        energy: Some(evaluation.energy()),
        forces: Some(evaluation.forces.clone()),
        stress: evaluation.stress(&state.structure),
    };
    // ASE has momenta in u Å per its own unit of time, Å √(u/eV): one fs is √(acceleration of 1 u by 1 eV/Å) of it.
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
