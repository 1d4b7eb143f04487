//! The interface of interatomic potentials.

use serde::{Deserialize, Serialize};

use crate::cell::{Matrix3, Vec3};
use crate::neighbours::NeighbourList;
use crate::species::Species;
use crate::structure::Structure;

/// Energy and its derivatives for one structure.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// Energy of each atom, `[n]`, eV.
    pub atomic_energies: Vec<f64>,
    /// −∂E/∂r, `[n]`, eV/Å.
    pub forces: Vec<Vec3>,
    /// −∂E/∂ε, eV (symmetric; stress = −virial / volume, tension positive).
    pub virial: Matrix3,
}

impl Evaluation {
    /// Resizes the arrays to `n` atoms and sets them to zero.
    pub fn reset(&mut self, n: usize) {
        self.atomic_energies.clear();
        self.atomic_energies.resize(n, 0.0);
        self.forces.clear();
        self.forces.resize(n, [0.0; 3]);
        self.virial = [[0.0; 3]; 3];
    }

    /// Total energy, eV.
    pub fn energy(&self) -> f64 {
        self.atomic_energies.iter().sum()
    }

    /// Stress = −virial / volume, eV/Å³, tension positive. For a slab or wire it refers to the whole cell
    /// including vacuum. `None` without periodic directions or if the lattice vectors do not span space.
    pub fn stress(&self, structure: &Structure) -> Option<Matrix3> {
        let volume = structure.cell.volume();
        let defined = structure.periodic != [false; 3] && volume > 0.0;
        defined.then(|| self.virial.map(|row| row.map(|w| -w / volume)))
    }
}

/// Why a potential cannot evaluate a structure.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PotentialError {
    /// The potential has no parameters for an element.
    #[error("atom {atom} is {species}, which the potential does not support (it supports {known})")]
    Species {
        /// Index of the atom.
        atom: usize,
        /// Its element.
        species: Species,
        /// Elements of the potential.
        known: String,
    },
    /// The cutoff of the neighbour list is too short.
    #[error("the neighbour list reaches {list} Å, the potential needs {needed} Å")]
    Cutoff {
        /// Cutoff of the list, Å.
        list: f64,
        /// Cutoff of the potential, Å.
        needed: f64,
    },
    /// The program that evaluates the potential cannot evaluate this structure.
    #[error("{0}")]
    Failed(String),
    /// The program that evaluates the potential does not answer any more.
    #[error("{0}")]
    Unavailable(String),
}

/// An interatomic potential. `&mut self` lets implementations keep scratch arrays between steps.
pub trait Potential: Send {
    /// The largest relevant pair distance, Å.
    fn cutoff(&self) -> f64;

    /// The supported elements.
    fn species(&self) -> &[Species];

    /// Writes energies, forces and virial of `structure` to `out`, replacing its content.
    ///
    /// `neighbours` must be up to date for `structure` and extend at least to [`Potential::cutoff`].
    fn evaluate(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError>;
}
