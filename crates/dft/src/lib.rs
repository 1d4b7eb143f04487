//! What calmwalk knows of the programs that make labels: their inputs, how to tell that a calculation is good, and
//! where its numbers stand. Files and numbers only; who runs the programs, and where, is not known here.
//!
//! Units: eV, Å, eV/Å, eV/Å³ (tension positive), μ_B. What a program writes in others is converted by its module.

pub mod abinit;
pub mod ase;
mod code;
pub mod command;
pub mod cp2k;
mod environment;
mod failure;
mod find;
pub mod gpaw;
mod judge;
mod lattice;
pub mod mesh;
mod moments;
mod original;
mod paw;
mod program;
mod remedy;
pub mod result_file;
mod same;
mod script_result;
mod setting;
mod settings;
mod smearing;
pub mod vasp;

pub use code::{Calculated, Code, Exit, Input, SetupError, Size};
pub use environment::PassedEnvironment;
pub use failure::{Failure, FailureClass};
pub use moments::Moments;
pub use original::Original;
pub use remedy::{Remedy, remedies};
pub use settings::Settings;
pub use smearing::Smearing;
