//! Species, positions, cell and periodicity.

use serde::{Deserialize, Serialize};

use crate::cell::{self, Cell, Vec3};
use crate::species::Species;

/// An atomic structure, the input of a potential.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Structure {
    /// The element of each atom, `[n]`.
    pub species: Vec<Species>,
    /// Cartesian positions, `[n]`, Å; not wrapped into the cell.
    pub positions: Vec<Vec3>,
    /// Lattice vectors.
    pub cell: Cell,
    /// Which lattice directions are periodic.
    pub periodic: [bool; 3],
}

/// Why a structure cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum StructureError {
    /// There are no atoms.
    #[error("the structure has no atoms")]
    Empty,
    /// Arrays of different lengths.
    #[error("{species} species but {positions} positions")]
    Length {
        /// Number of species.
        species: usize,
        /// Number of positions.
        positions: usize,
    },
    /// NaN or infinity among the positions.
    #[error("atom {0} has a position that is not finite")]
    Position(usize),
    /// NaN or infinity among the lattice vectors.
    #[error("the cell has entries that are not finite")]
    CellEntry,
    /// A periodic direction without extent.
    #[error("the cell is periodic but its volume is {0:.3e} Å³: its lattice vectors must span space")]
    CellVolume(f64),
    /// An atom is so far away that its lattice translation has no significant digits.
    #[error("atom {atom} is more than {limit:.0e} lattice vectors (or Å) away from the cell")]
    FarAway {
        /// Index of the atom.
        atom: usize,
        /// The limit.
        limit: f64,
    },
    /// The cell is so thin that the neighbour search would not end.
    #[error("the cell is {height:.3e} Å high, too thin to search neighbours within {reach:.3} Å")]
    CellThin {
        /// Smallest height of the cell along periodic directions, Å.
        height: f64,
        /// Cutoff + skin, Å.
        reach: f64,
    },
    /// Far more neighbours than any material has.
    #[error(
        "atom {atom} has more than {limit} neighbours within {reach:.3} Å: atoms overlap, or the cell is too small"
    )]
    Crowded {
        /// Index of the atom.
        atom: usize,
        /// The limit.
        limit: usize,
        /// Cutoff + skin, Å.
        reach: f64,
    },
    /// Two atoms closer than any bond.
    #[error("atoms {first} and {second} are {distance:.3} Å apart, less than {least:.3} Å")]
    Overlap {
        /// Lower index.
        first: usize,
        /// Higher index (equal for an atom and its own image).
        second: usize,
        /// Their distance, Å.
        distance: f64,
        /// The minimum distance, Å.
        least: f64,
    },
}

impl Structure {
    /// Number of atoms.
    pub fn len(&self) -> usize {
        self.species.len()
    }

    /// Whether there are no atoms.
    pub fn is_empty(&self) -> bool {
        self.species.is_empty()
    }

    /// Checks lengths, finite numbers and, where a direction is periodic, the volume.
    pub fn validate(&self) -> Result<(), StructureError> {
        if self.is_empty() {
            return Err(StructureError::Empty);
        }
        if self.species.len() != self.positions.len() {
            return Err(StructureError::Length {
                species: self.species.len(),
                positions: self.positions.len(),
            });
        }
        if let Some(atom) = self.positions.iter().position(|r| r.iter().any(|x| !x.is_finite())) {
            return Err(StructureError::Position(atom));
        }
        if self.cell.0.iter().flatten().any(|x| !x.is_finite()) {
            return Err(StructureError::CellEntry);
        }
        // Non-periodic directions may have any lattice vector, including zero.
        let lattice = self.cell.completed(self.periodic);
        let spanned: f64 = lattice.0.iter().map(|a| cell::norm(*a)).product();
        if lattice.volume().partial_cmp(&(1e-6 * spanned)) != Some(std::cmp::Ordering::Greater) {
            return Err(StructureError::CellVolume(lattice.volume()));
        }
        Ok(())
    }

    /// Formula with elements in alphabetical order, `"Al107"`, `"H2O"`.
    pub fn formula(&self) -> String {
        let mut counts = std::collections::BTreeMap::new();
        for species in &self.species {
            *counts.entry(species.symbol()).or_insert(0_usize) += 1;
        }
        counts
            .iter()
            .map(|(symbol, n)| if *n == 1 { (*symbol).to_owned() } else { format!("{symbol}{n}") })
            .collect()
    }
}
