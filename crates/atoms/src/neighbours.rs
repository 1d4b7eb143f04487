//! The neighbour list.

use crate::cell::{self, Vec3};
use crate::structure::{Structure, StructureError};

/// A directed bond i → j + image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Neighbour {
    /// Index of the neighbour.
    pub atom: u32,
    /// Which periodic image of it, in lattice vectors.
    pub image: [i32; 3],
}

impl Neighbour {
    /// d = r_j + image · cell − r_i, Å.
    #[inline]
    pub fn displacement(&self, structure: &Structure, i: usize) -> Vec3 {
        let rj = structure.positions[self.atom as usize];
        let d = cell::sub(rj, structure.positions[i]);
        if self.image == [0; 3] { d } else { cell::add(d, structure.cell.translation(self.image)) }
    }
}

/// Every directed pair within cutoff + skin, periodic images and self-images included.
///
/// The neighbours of an atom stand in canonical order (atom, then image), so that sums over those
/// within the cutoff give the same bits whenever the list was built.
#[derive(Clone, Debug)]
pub struct NeighbourList {
    cutoff: f64,
    skin: f64,
    offsets: Vec<usize>,
    neighbours: Vec<Neighbour>,
}

impl NeighbourList {
    /// An empty list that [`NeighbourList::update`] fills. `cutoff` and `skin` in Å.
    pub fn new(cutoff: f64, skin: f64) -> Self {
        Self { cutoff, skin, offsets: vec![0], neighbours: Vec::new() }
    }

    /// Makes the list valid for `structure`; true if it had to be built anew.
    pub fn update(&mut self, structure: &Structure) -> Result<bool, StructureError> {
        structure.validate()?;
        let reach = self.cutoff + self.skin;
        let heights = structure.cell.heights();
        let n: [i32; 3] = std::array::from_fn(|k| {
            if structure.periodic[k] { (reach / heights[k]).ceil() as i32 + 1 } else { 0 }
        });
        self.offsets = vec![0];
        self.neighbours.clear();
        for i in 0..structure.len() {
            for j in 0..structure.len() as u32 {
                for a in -n[0]..=n[0] {
                    for b in -n[1]..=n[1] {
                        for c in -n[2]..=n[2] {
                            let neighbour = Neighbour { atom: j, image: [a, b, c] };
                            let d = cell::norm(neighbour.displacement(structure, i));
                            if d <= reach && !(j as usize == i && [a, b, c] == [0; 3]) {
                                self.neighbours.push(neighbour);
                            }
                        }
                    }
                }
            }
            self.offsets.push(self.neighbours.len());
        }
        Ok(true)
    }

    /// Pairs up to this distance are complete, Å.
    pub fn cutoff(&self) -> f64 {
        self.cutoff
    }

    /// Neighbours of atom `i` within cutoff + skin (a few may be farther than the cutoff).
    #[inline]
    pub fn of(&self, i: usize) -> &[Neighbour] {
        &self.neighbours[self.offsets[i]..self.offsets[i + 1]]
    }
}
