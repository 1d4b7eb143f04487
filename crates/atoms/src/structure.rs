//! Species, positions, cell and periodicity.

use serde::{Deserialize, Serialize};

use crate::cell::{self, Cell, Vec3};
use crate::species::Species;

/// A piece of matter: what a potential is evaluated on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Structure {
    /// The element of each atom, [n].
    pub species: Vec<Species>,
    /// Cartesian positions, [n], Å. They are not wrapped into the cell.
    pub positions: Vec<Vec3>,
    /// Lattice vectors.
    pub cell: Cell,
    /// Whether each lattice direction repeats.
    pub periodic: [bool; 3],
}

/// Why a structure cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum StructureError {
    /// No atoms at all.
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
    /// An atom so far away that its lattice translation loses all digits.
    #[error("atom {atom} is more than {limit:.0e} lattice vectors (or Å) away from the cell")]
    FarAway {
        /// Index of the atom.
        atom: usize,
        /// The limit.
        limit: f64,
    },
    /// A cell so thin that the search for neighbours would not end.
    #[error("the cell is {height:.3e} Å high, far too thin to find the neighbours within {reach:.3} Å")]
    CellThin {
        /// Least height of the cell among the directions that repeat, Å.
        height: f64,
        /// Cutoff + skin, Å.
        reach: f64,
    },
    /// Far more neighbours than matter has.
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
        /// The least distance allowed, Å.
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
        // Directions that do not repeat may have any lattice vector, also none.
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
