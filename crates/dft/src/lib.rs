//! Interfaces to the programs that make labels: their inputs, the validation of their outputs, and the
//! adjustments of a retry. This crate handles files and numbers only and runs no calculations.
//!
//! Units: eV, Å, eV/Å, eV/Å³ (tension positive), μ_B. The module of each program converts from the program's
//! own units.

pub mod abinit;
pub mod ase;
mod backend;
mod checks;
pub mod command;
pub mod cp2k;
mod environment;
pub mod espresso;
mod executable;
mod failure;
pub mod gpaw;
mod installed;
pub mod k_mesh;
mod moments;
mod padded_structure;
mod paw;
mod pinned_file;
pub mod result_file;
mod retry_adjustment;
mod script_output;
mod settings;
mod smearing;
mod structure_check;
mod validation;
pub mod vasp;
mod version_query;

pub use backend::{CalculationInput, CalculationResults, CalculationSize, DftBackend, Exit, SetupError};
pub use environment::PassedEnvironment;
pub use failure::{Failure, FailureClass};
pub use installed::{InstalledCode, installed_codes};
pub use moments::InitialMagneticMoments;
pub use pinned_file::PinnedFile;
pub use retry_adjustment::{RetryAdjustment, adjustments};
pub use settings::DftSettings;
pub use smearing::Smearing;
pub use version_query::{ProgramError, output_of};
