//! Errors.

use atoms::{PotentialError, StructureError};

/// Why a run cannot start or continue. After an error in a step, continue from a checkpoint.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DynamicsError {
    /// The structure became invalid.
    #[error(transparent)]
    Structure(#[from] StructureError),
    /// The potential failed.
    #[error(transparent)]
    Potential(#[from] PotentialError),
    /// The potential returned NaN or infinity.
    #[error("the potential gives an energy or force that is not finite on atom {atom} at step {step}")]
    NotFinite {
        /// Index of the atom.
        atom: usize,
        /// The step.
        step: u64,
    },
    /// Arrays of different lengths.
    #[error("the run has {found} {array} for {expected} atoms")]
    Length {
        /// Which array.
        array: &'static str,
        /// Its length.
        found: usize,
        /// Number of atoms.
        expected: usize,
    },
    /// A time step that is not positive.
    #[error("the time step is {0} fs: it must be positive and finite")]
    TimeStep(f64),
    /// Invalid thermostat settings.
    #[error("thermostat: {0}")]
    Thermostat(&'static str),
    /// Invalid settings or variables of the barostat.
    #[error("barostat: {0}")]
    Barostat(&'static str),
    /// The cell changes too fast.
    #[error(
        "the cell changes by {percent:.1} % in step {step}: its pressure, stress or relaxation time tears it apart"
    )]
    CellStrain {
        /// The largest change of a length in one step, %.
        percent: f64,
        /// The step.
        step: u64,
    },
    /// The cell has a volume that no material has.
    #[error(
        "the volume is {ratio:.3} of that at the start at step {step}: the structure is not stable at the set pressure"
    )]
    CellVolume {
        /// Volume relative to that at the start.
        ratio: f64,
        /// The step.
        step: u64,
    },
    /// The potential returned a virial that is NaN or infinite.
    #[error("the potential gives a stress that is not finite at step {step}")]
    StressNotFinite {
        /// The step.
        step: u64,
    },
    /// Invalid settings of the volume ramp.
    #[error("the volume ramp goes from {from} V₀ to {to} V₀: both, and V₀, must be positive and finite")]
    Ramp {
        /// V/V₀ at the start.
        from: f64,
        /// V/V₀ at the end.
        to: f64,
    },
}
