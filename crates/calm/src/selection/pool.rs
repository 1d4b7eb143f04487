//! The atoms that a selection looks at.

use std::io;
use std::ops::Range;
use std::path::PathBuf;

use super::rows::FeatureRows;

/// Which grades count: an atom whose γ is within the window may cause its structure to be picked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Window {
    /// γ must be above this.
    pub above: f64,
    /// γ must not be above this; `f64::INFINITY` without a limit.
    pub up_to: f64,
}

impl Window {
    /// Whether a grade is within.
    pub fn has(&self, gamma: f64) -> bool {
        gamma > self.above && gamma <= self.up_to
    }
}

/// What is known of an atom besides its features.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoolAtom {
    /// γ under the mixture that graded the pool.
    pub gamma: f64,
    /// Its structure.
    pub structure: u32,
    /// Element index.
    pub element: u16,
    /// Nearest component of its element.
    pub slot: u16,
}

/// The atoms of the structures of a pool, by structure. Atoms that no strategy needs are left out.
///
/// Memory: 8 bytes for each structure and 16 + 8 D for each atom, of whose features those beyond a limit are in a temporary file.
#[derive(Debug)]
pub struct Pool {
    window: Window,
    /// Also keep atoms outside the window.
    all_atoms: bool,
    /// First atom of each structure, and the number of atoms: `[structures + 1]`.
    first: Vec<usize>,
    atoms: Vec<PoolAtom>,
    features: FeatureRows,
}

impl Pool {
    /// No structures. With `all_atoms`, atoms outside the window are kept too. Features beyond `memory` bytes are in a temporary
    /// file in `directory`.
    pub fn new(dimension: usize, window: Window, all_atoms: bool, memory: usize, directory: PathBuf) -> Self {
        let features = FeatureRows::new(dimension, memory, directory);
        Self { window, all_atoms, first: vec![0], atoms: Vec::new(), features }
    }

    /// Adds a structure, from element index, nearest component and γ of each atom, and the features `[atoms × D]`.
    ///
    /// # Errors
    /// A temporary file that cannot be written, a 2³²nd structure, an index of an element or a component above 65,535.
    pub fn push(
        &mut self,
        elements: &[usize],
        slots: &[usize],
        gamma: &[f64],
        features: &[f64],
    ) -> io::Result<()> {
        let large = |_| io::Error::other("too many structures, elements or components");
        let structure = u32::try_from(self.len()).map_err(large)?;
        let rows = features.chunks_exact(self.features.dimension());
        for (((&element, &slot), &gamma), row) in elements.iter().zip(slots).zip(gamma).zip(rows) {
            if self.all_atoms || self.window.has(gamma) {
                let (element, slot) =
                    (u16::try_from(element).map_err(large)?, u16::try_from(slot).map_err(large)?);
                self.atoms.push(PoolAtom { gamma, structure, element, slot });
                self.features.push(row)?;
            }
        }
        self.first.push(self.atoms.len());
        Ok(())
    }

    /// Number of structures.
    pub fn len(&self) -> usize {
        self.first.len() - 1
    }

    /// Whether there is no structure.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The grades that count.
    pub fn window(&self) -> Window {
        self.window
    }

    /// Every atom that was kept.
    pub fn atoms(&self) -> &[PoolAtom] {
        &self.atoms
    }

    /// Their features.
    pub fn features(&self) -> &FeatureRows {
        &self.features
    }

    /// The atoms of a structure that were kept.
    fn atoms_of(&self, structure: usize) -> Range<usize> {
        self.first[structure]..self.first[structure + 1]
    }

    /// Those of them within the window.
    pub fn window_atoms_of(&self, structure: usize) -> impl Iterator<Item = usize> {
        self.atoms_of(structure).filter(|&atom| self.window.has(self.atoms[atom].gamma))
    }

    /// Features of some atoms, one after another, `[atoms × D]`.
    ///
    /// # Errors
    /// A temporary file that cannot be read.
    pub fn features_of(&self, atoms: &[usize]) -> io::Result<Vec<f64>> {
        let mut features = Vec::with_capacity(atoms.len() * self.features.dimension());
        for &atom in atoms {
            self.features.read(atom..atom + 1, &mut features)?;
        }
        Ok(features)
    }
}
