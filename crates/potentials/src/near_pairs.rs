//! Neighbours within the cutoff, packed for vector instructions.

use atoms::cell::{dot, sub};
use atoms::{Neighbour, Vec3};

/// Number of pairs that are processed together.
pub(crate) const LANES: usize = 8;

/// One number for each of eight pairs.
pub(crate) type Lanes = [f64; LANES];

/// The sum over eight pairs, always in the same order.
#[inline(always)]
pub(crate) fn sum(x: &Lanes) -> f64 {
    ((x[0] + x[4]) + (x[1] + x[5])) + ((x[2] + x[6]) + (x[3] + x[7]))
}

/// Selects the neighbours within the cutoff without a branch per neighbour.
#[derive(Clone, Debug, Default)]
pub(crate) struct NearPairs {
    /// Positions of all sites of the neighbour list, Å.
    pub positions: Vec<Vec3>,
    /// d and d², Å and Å².
    found: Vec<[f64; 4]>,
    atoms: Vec<u32>,
}

impl NearPairs {
    /// The neighbours of atom `i` closer than the square root of `squared_cutoff`, Å²: d, d² and their indices.
    /// They keep the order of the list, so that sums do not depend on what else is in it.
    #[inline(always)]
    pub fn collect(
        &mut self,
        i: usize,
        neighbours: &[Neighbour],
        sites: &[u32],
        squared_cutoff: f64,
    ) -> (&[[f64; 4]], &[u32]) {
        if self.atoms.len() < neighbours.len() {
            self.found.resize(neighbours.len(), [0.0; 4]);
            self.atoms.resize(neighbours.len(), 0);
        }
        let (found, atoms) = (&mut self.found[..neighbours.len()], &mut self.atoms[..neighbours.len()]);
        let centre = self.positions[i];
        let mut count = 0;
        for (neighbour, site) in neighbours.iter().zip(sites) {
            let d = sub(self.positions[*site as usize], centre);
            let squared = dot(d, d);
            // Write always and count only if near: a branch would be mispredicted every few pairs.
            found[count] = [d[0], d[1], d[2], squared];
            atoms[count] = neighbour.atom;
            count += usize::from(squared < squared_cutoff);
        }
        (&found[..count], &atoms[..count])
    }
}
