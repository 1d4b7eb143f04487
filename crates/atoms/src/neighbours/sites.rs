//! The distinct positions of neighbours: atoms and periodic images, each once.

use super::Neighbour;
use crate::cell::{self, Vec3};
use crate::structure::Structure;

/// The sites of a list: the first n are the n atoms, the rest are images.
#[derive(Clone, Debug, Default)]
pub(super) struct Sites {
    images: Vec<Neighbour>,
    /// The site of each neighbour.
    pub of_neighbour: Vec<u32>,
}

impl Sites {
    pub fn clear(&mut self) {
        self.images.clear();
        self.of_neighbour.clear();
    }

    /// Assigns site numbers. The neighbours of atom i start at `offsets[i]`.
    ///
    /// For each bond i → j + image the list holds the reverse, j → i − image. The images of an atom that occur
    /// in the list are therefore those of its own neighbours, negated.
    pub fn number(&mut self, offsets: &[usize], neighbours: &[Neighbour]) {
        self.clear();
        let atoms = offsets.len() - 1;
        let mut starts = Vec::with_capacity(atoms + 1);
        for atom in 0..atoms {
            let start = self.images.len();
            starts.push(start);
            for neighbour in &neighbours[offsets[atom]..offsets[atom + 1]] {
                let image = neighbour.image.map(|n| -n);
                if image != [0; 3] && !self.images[start..].iter().any(|seen| seen.image == image) {
                    self.images.push(Neighbour { atom: atom as u32, image });
                }
            }
        }
        starts.push(self.images.len());
        let (images, starts) = (&self.images, &starts);
        self.of_neighbour.extend(neighbours.iter().map(|&Neighbour { atom, image }| {
            if image == [0; 3] {
                return atom;
            }
            let start = starts[atom as usize];
            let own = &images[start..starts[atom as usize + 1]];
            let place = own.iter().position(|seen| seen.image == image).expect("the reverse is in the list");
            (atoms + start + place) as u32
        }));
    }

    /// Writes the positions of all sites, Å, for the current structure.
    pub fn positions(&self, structure: &Structure, positions: &mut Vec<Vec3>) {
        positions.clear();
        positions.extend_from_slice(&structure.positions);
        positions.extend(self.images.iter().map(|site| {
            cell::add(structure.positions[site.atom as usize], structure.cell.translation(site.image))
        }));
    }
}
