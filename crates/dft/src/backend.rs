//! The interface to a program that makes labels.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use atoms::cell::{Matrix3, Vec3};
use atoms::{Species, Structure};

use crate::{Failure, FailureClass, PinnedFile, RetryAdjustment};

/// A configured program that makes labels. Each program's settings locate the program and its
/// pseudopotentials and create it.
///
/// Steps of a label: write the files of [`Self::input`] to an empty directory, run the command there, and pass
/// the directory to [`Self::read`].
pub trait DftBackend: Send + Sync {
    /// Everything that changes the value of a label: settings, program version, hashes of pseudopotentials.
    /// Labels of equal identity may share a data set. Excludes what only changes the run time.
    fn identity(&self) -> serde_json::Value;

    /// Checks that it can label structures with these species.
    ///
    /// # Errors
    /// [`SetupError`] for the first species without a matching pseudopotential.
    fn supports(&self, species: &BTreeSet<Species>) -> Result<(), SetupError>;

    /// The input files and the command of a calculation.
    ///
    /// # Errors
    /// [`FailureClass::BadInput`](crate::FailureClass) if the program's input cannot express the structure.
    fn input(
        &self,
        structure: &Structure,
        adjustments: &BTreeSet<RetryAdjustment>,
    ) -> Result<CalculationInput, Failure>;

    /// Reads the results of the calculation in `directory`, which ended with `exit`. Accepts them only if the
    /// program states convergence and calculated exactly the requested structure: atoms, order, species and
    /// cell. If another version of the program made the output, the failure is
    /// [`FailureClass::OtherProgram`](crate::FailureClass).
    ///
    /// # Errors
    /// Why there is no label. Output that cannot be read is a failure like any other.
    fn read(
        &self,
        structure: &Structure,
        directory: &Path,
        exit: Exit,
    ) -> Result<CalculationResults, Failure>;

    /// The quantities that determine the cost of a calculation.
    fn size(&self, structure: &Structure) -> CalculationSize;
}

/// Input of a calculation.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CalculationInput {
    /// Content of each file by its name in the directory.
    pub files: BTreeMap<String, Vec<u8>>,
    /// The program with its arguments. Its output is kept in the files `stdout` and `stderr` beside the others.
    pub command: Vec<String>,
    /// Additional environment variables.
    pub environment: BTreeMap<String, String>,
    /// Large files that the program also reads, such as pseudopotentials. They are copied under these names
    /// into the folder `data` beside the directory. All calculations share them, so they need not be kept.
    pub data: BTreeMap<String, PinnedFile>,
}

/// How a program ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// It returned this exit code; many programs return 0 in any case.
    Code(i32),
    /// A signal ended it.
    Signal(i32),
    /// It exceeded its time limit.
    TimeLimit,
    /// It exceeded its memory limit.
    OutOfMemory,
    /// Its node was lost.
    LostNode,
}

impl Exit {
    /// The failure that follows from this end if the program's files give no better reason.
    pub fn failure(self) -> Failure {
        match self {
            Self::Code(code) => FailureClass::Crashed.with_message(format!("ended with exit code {code}")),
            Self::Signal(signal) => FailureClass::Crashed.with_message(format!("ended by signal {signal}")),
            Self::TimeLimit => FailureClass::TimeLimit.with_message("exceeded its time limit"),
            Self::OutOfMemory => FailureClass::OutOfMemory.with_message("exceeded its memory limit"),
            Self::LostNode => FailureClass::NodeFailure.with_message("the node it ran on was lost"),
        }
    }
}

/// The results of a calculation.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CalculationResults {
    /// The energy consistent with the forces, eV: with smearing, the free energy.
    pub energy: f64,
    /// The energy extrapolated to zero smearing, eV, if the program reports it.
    pub energy_without_smearing: Option<f64>,
    /// Forces, `[n]`, eV/Å.
    pub forces: Vec<Vec3>,
    /// Stress, eV/Å³, tension positive; `None` if it is undefined or not reported.
    pub stress: Option<Matrix3>,
    /// Magnetic moment of each atom, `[n]`, μ_B; `None` without spin or if not reported.
    pub magnetic_moments: Option<Vec<f64>>,
    /// Magnetic moment of the cell, μ_B.
    pub magnetisation: Option<f64>,
    /// Number of electronic steps.
    pub electronic_steps: Option<u32>,
}

/// The quantities that determine the cost of a calculation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CalculationSize {
    /// Number of atoms.
    pub atoms: usize,
    /// Number of valence electrons; 0 if unknown.
    pub electrons: f64,
    /// Number of k-points before symmetry; 1 without a mesh.
    pub k_points: usize,
}

/// Why a program is unusable; found before anything runs.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SetupError {
    /// The program is missing or does not start.
    #[error("{program}: {reason}")]
    Program {
        /// Its name in the settings.
        program: String,
        /// What is wrong and how to fix it.
        reason: String,
    },
    /// A pseudopotential is missing or does not match.
    #[error("pseudopotential of {species}: {reason}")]
    Pseudopotential {
        /// The element.
        species: Species,
        /// What is wrong, with the path, and how to fix it.
        reason: String,
    },
    /// A setting has an invalid value.
    #[error("{key}: found {found}, expected {expected}")]
    Setting {
        /// The key in the method's section.
        key: &'static str,
        /// Its value.
        found: String,
        /// The valid values.
        expected: String,
    },
}

impl SetupError {
    /// No file for an element in the directory of pseudopotentials; `sought` are the names that would do.
    pub(crate) fn missing_pseudopotential(species: Species, sought: &str, directory: &Path) -> Self {
        let reason = format!(
            "no {sought} in {}: get one for PBE and set `pseudopotentials` to its directory; if its \
             name differs, set its file in `pseudopotential_variants`",
            directory.display()
        );
        Self::Pseudopotential { species, reason }
    }
}
