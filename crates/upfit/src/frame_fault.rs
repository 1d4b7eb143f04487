//! Why a labelled structure cannot be used.

use atoms::{PotentialError, StructureError};

/// Larger forces are taken for broken labels, eV/Å.
pub const MAX_FORCE: f64 = 1000.0;
/// Larger differences between the energies of labels and model are taken for broken labels, eV/atom.
pub const MAX_ENERGY_DIFFERENCE: f64 = 1000.0;

/// Why a labelled structure cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FrameFault {
    /// No forces.
    #[error("the structure has no forces; expected labels with energy (eV) and forces (eV/Å)")]
    NoForces,
    /// No energy.
    #[error("the structure has no energy; expected labels with energy (eV) and forces (eV/Å)")]
    NoEnergy,
    /// Forces of another number of atoms.
    #[error("the labels have {forces} forces, the structure has {atoms} atoms")]
    NumberOfForces {
        /// Number of forces.
        forces: usize,
        /// Number of atoms.
        atoms: usize,
    },
    /// NaN or infinity among the labels.
    #[error("{0} of the labels is not finite")]
    NotFinite(&'static str),
    /// A force that no calculation of a sensible structure gives.
    #[error("the force on atom {atom} is {size:.4e} eV/Å, expected at most {limit} eV/Å", limit = MAX_FORCE)]
    LargeForce {
        /// Index of the atom.
        atom: usize,
        /// |F|, eV/Å.
        size: f64,
    },
    /// An energy that no shift of the elements explains.
    #[error(
        "the energy differs from the model's by {difference:.4e} eV/atom, expected at most {limit} eV/atom",
        limit = MAX_ENERGY_DIFFERENCE
    )]
    FarEnergy {
        /// Label − model, with the shifts of the elements, eV/atom.
        difference: f64,
    },
    /// A weight that is negative or not finite.
    #[error("the weight is {0}, expected a number, 0 or more")]
    Weight(f64),
    /// The model gives NaN or infinity.
    #[error("the model's energy, forces or stress of the structure are not finite: atoms may overlap")]
    ModelNotFinite,
    /// An invalid structure.
    #[error(transparent)]
    Structure(#[from] StructureError),
    /// The model cannot evaluate the structure.
    #[error(transparent)]
    Potential(#[from] PotentialError),
}
