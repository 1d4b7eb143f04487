//! What a program that makes labels must be able to do.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use atoms::cell::{Matrix3, Vec3};
use atoms::{Species, Structure};

use crate::{Failure, FailureClass, PinnedFile, RetryAdjustment};

/// A program that makes labels, with its settings. It is made by its module's `Settings`, which finds the program and
/// its pseudopotentials.
///
/// A label is made in this order: [`Self::input`] gives files, which are written to an empty directory; the program is
/// run there; [`Self::read`] judges what it left.
pub trait DftBackend: Send + Sync {
    /// Everything that changes a label's value: settings, version of the program, hashes of pseudopotentials. Labels of
    /// equal identity may stand in one data set. Nothing that only changes how long it takes.
    fn identity(&self) -> serde_json::Value;

    /// Whether it can label structures of these species.
    ///
    /// # Errors
    /// [`SetupError`] for the first that it cannot: no pseudopotential, a title that does not fit.
    fn supports(&self, species: &BTreeSet<Species>) -> Result<(), SetupError>;

    /// The files that a calculation starts from, and the command.
    ///
    /// # Errors
    /// [`FailureClass::BadInput`](crate::FailureClass) if the structure cannot be written for this program.
    fn input(&self, structure: &Structure, adjustments: &BTreeSet<RetryAdjustment>)
    -> Result<Input, Failure>;

    /// Judges the calculation that was run in `directory` and ended so, and reads its numbers. Nothing is believed
    /// unless the program says that it converged and has calculated the very structure that was asked for: atoms, order,
    /// species and cell. What says that another version of the program has made it is
    /// [`FailureClass::OtherProgram`](crate::FailureClass).
    ///
    /// # Errors
    /// Why it is no label. What can no longer be read is a failure like any other.
    fn read(&self, structure: &Structure, directory: &Path, exit: Exit) -> Result<Results, Failure>;

    /// What its cost depends on.
    fn size(&self, structure: &Structure) -> Size;
}

/// What a calculation starts from.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Input {
    /// Content of each file by its name in the directory.
    pub files: BTreeMap<String, Vec<u8>>,
    /// The program with its arguments; what it prints is kept in the files `stdout` and `stderr` beside the others.
    pub command: Vec<String>,
    /// What is added to its environment.
    pub environment: BTreeMap<String, String>,
    /// Large files that the program reads besides, such as pseudopotentials: copies of these are put into the folder `data`
    /// beside the directory, by these names. All calculations have the same, and so they need not be kept.
    pub data: BTreeMap<String, PinnedFile>,
}

/// How a program ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// With this code: many programs say 0 whatever happened.
    Code(i32),
    /// By this signal.
    Signal(i32),
    /// It was ended because its time was over.
    TimeLimit,
    /// It was ended because it used too much memory.
    OutOfMemory,
    /// The machine it ran on was lost.
    LostNode,
}

impl Exit {
    /// The failure that this end means where the program's files tell nothing better.
    pub fn failure(self) -> Failure {
        match self {
            Self::Code(code) => FailureClass::Crashed.with_message(format!("ended with exit code {code}")),
            Self::Signal(signal) => FailureClass::Crashed.with_message(format!("ended by signal {signal}")),
            Self::TimeLimit => FailureClass::TimeLimit.with_message("ended because its time was over"),
            Self::OutOfMemory => {
                FailureClass::OutOfMemory.with_message("ended because it used too much memory")
            }
            Self::LostNode => FailureClass::LostNode.with_message("the machine that it ran on was lost"),
        }
    }
}

/// The numbers of a calculation.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Results {
    /// The energy whose derivative the forces are, eV: with smearing, the free energy.
    pub energy: f64,
    /// Extrapolated to no smearing, eV; none if the program gives none.
    pub energy_without_smearing: Option<f64>,
    /// Forces, [n], eV/Å.
    pub forces: Vec<Vec3>,
    /// Stress, eV/Å³, tension positive; none where it is not defined or not given.
    pub stress: Option<Matrix3>,
    /// Magnetic moment of each atom, [n], μ_B; none without spin or if the program gives none.
    pub magnetic_moments: Option<Vec<f64>>,
    /// Magnetic moment of the cell, μ_B.
    pub magnetisation: Option<f64>,
    /// Electronic steps that it took.
    pub electronic_steps: Option<u32>,
}

/// What the cost of a calculation depends on.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Size {
    /// Atoms.
    pub atoms: usize,
    /// Electrons that the program treats (valence); 0 where that is unknown.
    pub electrons: f64,
    /// Points of the k-point mesh, without symmetry; 1 where there is none.
    pub k_points: usize,
}

/// Why a program cannot be used at all: found before anything is run.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SetupError {
    /// The program is not there, or does not start.
    #[error("{program}: {reason}")]
    Program {
        /// As the settings call it.
        program: String,
        /// What is wrong, and what to do.
        reason: String,
    },
    /// A pseudopotential is missing or is not what it should be.
    #[error("pseudopotential of {species}: {reason}")]
    Pseudopotential {
        /// The element.
        species: Species,
        /// What is wrong, with the path, and what to do.
        reason: String,
    },
    /// A setting has an impossible value.
    #[error("{key}: found {found}, expected {expected}")]
    Setting {
        /// The key in the method's section.
        key: &'static str,
        /// Its value.
        found: String,
        /// What it may be.
        expected: String,
    },
}
