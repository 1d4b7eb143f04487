//! The neighbour list.

mod linked_cells;
mod sites;

use std::sync::atomic::{AtomicU64, Ordering};

use crate::cell::{self, Matrix3, Vec3};
use crate::structure::{Structure, StructureError};
use linked_cells::LinkedCells;
use sites::Sites;

/// Number of the next build of a list.
static NEXT_BUILD: AtomicU64 = AtomicU64::new(1);

/// An atom with more neighbours means overlapping atoms or a collapsed cell.
const MAX_NEIGHBOURS: usize = 20_000;

/// A directed bond i → j + image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Neighbour {
    /// Index of the neighbour.
    pub atom: u32,
    /// Its periodic image, in lattice vectors relative to the unwrapped positions.
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

/// A directed bond with its geometry.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bond {
    /// Index of the neighbour.
    pub atom: u32,
    /// d = r_j + image · cell − r_i, Å.
    pub d: Vec3,
    /// |d|, Å.
    pub r: f64,
}

/// All directed pairs within cutoff + skin, including periodic images and self-images.
///
/// The neighbours of an atom are in canonical order (atom, then image), so sums over those within the cutoff
/// have the same bits whenever the list was built. Non-periodic lattice vectors are ignored, and positions are
/// never wrapped.
#[derive(Clone, Debug)]
pub struct NeighbourList {
    cutoff: f64,
    skin: f64,
    /// The structure for which the list was built.
    reference: Option<Structure>,
    build_number: u64,
    offsets: Vec<usize>,
    /// Index of the first later neighbour of each atom.
    later: Vec<usize>,
    neighbours: Vec<Neighbour>,
    sites: Sites,
}

impl NeighbourList {
    /// An empty list; [`NeighbourList::update`] fills it. `cutoff` and `skin` in Å.
    pub fn new(cutoff: f64, skin: f64) -> Self {
        Self {
            cutoff,
            skin,
            reference: None,
            build_number: 0,
            offsets: vec![0],
            later: Vec::new(),
            neighbours: Vec::new(),
            sites: Sites::default(),
        }
    }

    /// Makes the list valid for `structure`. Returns true if it was rebuilt.
    ///
    /// # Errors
    /// If the structure is invalid, an atom is extremely far away or has extremely many neighbours, or the cell
    /// is too thin. The list is then empty.
    pub fn update(&mut self, structure: &Structure) -> Result<bool, StructureError> {
        let valid = structure.validate();
        if valid.is_ok() && self.reference.as_ref().is_some_and(|old| self.still_complete(old, structure)) {
            return Ok(false);
        }
        self.clear();
        valid?;
        if let Err(error) = self.build(structure) {
            self.clear();
            return Err(error);
        }
        self.reference = Some(structure.clone());
        self.build_number = NEXT_BUILD.fetch_add(1, Ordering::Relaxed);
        Ok(true)
    }

    /// Another number after each build of any list of this process: lists of the same number have the same neighbours. 0 without
    /// a build.
    pub fn build_number(&self) -> u64 {
        self.build_number
    }

    /// All pairs within this distance are in the list, Å.
    pub fn cutoff(&self) -> f64 {
        self.cutoff
    }

    /// Number of atoms in the list; 0 before the first update.
    pub fn len(&self) -> usize {
        self.offsets.len() - 1
    }

    /// Whether the list holds no atoms.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Neighbours of atom `i` within cutoff + skin, of which some are beyond the cutoff.
    #[inline]
    pub fn neighbours_of(&self, i: usize) -> &[Neighbour] {
        &self.neighbours[self.offsets[i]..self.offsets[i + 1]]
    }

    /// The neighbours of atom `i` that follow `i` in canonical order (half list): over all atoms each pair
    /// once.
    #[inline]
    pub fn later_neighbours_of(&self, i: usize) -> &[Neighbour] {
        &self.neighbours[self.later[i]..self.offsets[i + 1]]
    }

    /// The index of each [later neighbour](Self::later_neighbours_of) of atom `i` in
    /// [`NeighbourList::site_positions`].
    #[inline]
    pub fn later_sites_of(&self, i: usize) -> &[u32] {
        &self.sites.of_neighbour[self.later[i]..self.offsets[i + 1]]
    }

    /// Writes the positions of all atoms, Å, followed by those of all periodic images that are neighbours. Each
    /// is computed once instead of once per bond.
    pub fn site_positions(&self, structure: &Structure, positions: &mut Vec<Vec3>) {
        self.sites.positions(structure, positions);
    }

    /// Writes the bonds of atom `i` shorter than `cutoff` (Å, at most that of the list) into `bonds`.
    #[inline]
    pub fn bonds_within(&self, structure: &Structure, i: usize, cutoff: f64, bonds: &mut Vec<Bond>) {
        bonds.clear();
        for neighbour in self.neighbours_of(i) {
            let d = neighbour.displacement(structure, i);
            let square = cell::dot(d, d);
            if square < cutoff * cutoff {
                bonds.push(Bond { atom: neighbour.atom, d, r: square.sqrt() });
            }
        }
    }

    fn clear(&mut self) {
        self.reference = None;
        self.build_number = 0;
        self.offsets.truncate(1);
        self.later.clear();
        self.neighbours.clear();
        self.sites.clear();
    }

    fn build(&mut self, structure: &Structure) -> Result<(), StructureError> {
        let reach = self.cutoff + self.skin;
        let cells = LinkedCells::new(structure, reach)?;
        let mut found = Vec::with_capacity(self.neighbours.capacity());
        let (mut ends, mut near) = (Vec::with_capacity(structure.len()), Vec::new());
        for i in 0..structure.len() {
            let start = found.len();
            let own = Neighbour { atom: i as u32, image: [0; 3] };
            let is_within = |neighbour: Neighbour| {
                let d = neighbour.displacement(structure, i);
                cell::dot(d, d) <= reach * reach
            };
            cells.candidates(i, &mut near, |neighbour, certain| {
                if (certain || is_within(neighbour)) && neighbour != own {
                    found.push(neighbour);
                }
                if found.len() - start > MAX_NEIGHBOURS {
                    return Err(StructureError::Crowded { atom: i, limit: MAX_NEIGHBOURS, reach });
                }
                Ok(())
            })?;
            ends.push(found.len());
        }
        self.sort(&found, &ends);
        for i in 0..structure.len() {
            let own = Neighbour { atom: i as u32, image: [0; 3] };
            self.later
                .push(self.offsets[i] + self.neighbours_of(i).partition_point(|neighbour| *neighbour < own));
        }
        self.sites.number(&self.offsets, &self.neighbours);
        Ok(())
    }

    /// Fills the list with the reverse of each bond found: for i → j + image, j → i − image.
    ///
    /// The reverse of each bond was found too, because the two displacements are exactly opposite. Visiting
    /// atoms in ascending order yields the reverse bonds of each atom ordered by neighbour. Images were found
    /// in ascending order, so visiting them backwards orders these too. This gives the canonical order without
    /// comparisons.
    fn sort(&mut self, found: &[Neighbour], ends: &[usize]) {
        let mut next = vec![0; ends.len() + 1];
        found.iter().for_each(|neighbour| next[neighbour.atom as usize + 1] += 1);
        for i in 0..ends.len() {
            next[i + 1] += next[i];
        }
        self.offsets.extend_from_slice(&next[1..]);
        self.neighbours.resize(found.len(), Neighbour { atom: 0, image: [0; 3] });
        let mut start = 0;
        for (i, &end) in ends.iter().enumerate() {
            for &Neighbour { atom, image } in found[start..end].iter().rev() {
                let slot = &mut next[atom as usize];
                self.neighbours[*slot] = Neighbour { atom: i as u32, image: image.map(|n| -n) };
                *slot += 1;
            }
            start = end;
        }
    }

    /// Whether no pair outside the list can be within the cutoff.
    ///
    /// With the deformation gradient F of the cell and the displacement u of each atom from its affinely
    /// deformed reference position, d = d₀ F + u_j − u_i, so |d| ≥ s_min(F) |d₀| − 2 max|u|. This holds for any
    /// F that maps the periodic lattice vectors correctly.
    fn still_complete(&self, reference: &Structure, structure: &Structure) -> bool {
        if reference == structure {
            return true;
        }
        if reference.periodic != structure.periodic
            || reference.species != structure.species
            || reference.positions.len() != structure.positions.len()
        {
            return false;
        }
        let f = deformation_gradient(reference, structure);
        let largest = reference
            .positions
            .iter()
            .zip(&structure.positions)
            .map(|(old, new)| cell::sub(*new, cell::row_times(*old, &f)))
            .map(|u| cell::dot(u, u))
            .fold(0.0, f64::max);
        let least = min_singular_value(&f) * (self.cutoff + self.skin) - 2.0 * largest.sqrt();
        // Margin for rounding in the singular value.
        least > self.cutoff * (1.0 + 1e-7)
    }
}

/// The shortest pair (i ≤ j, distance in Å); of equals, the one with the lowest indices. i = j for an atom and
/// its own image. `None` if no pair is in the list.
pub fn shortest_distance(structure: &Structure, neighbours: &NeighbourList) -> Option<(usize, usize, f64)> {
    let mut shortest = None;
    let mut least = f64::INFINITY;
    for i in 0..neighbours.len() {
        for neighbour in neighbours.later_neighbours_of(i) {
            let d = neighbour.displacement(structure, i);
            let squared = cell::dot(d, d);
            if squared < least {
                least = squared;
                shortest = Some((i, neighbour.atom as usize));
            }
        }
    }
    shortest.map(|(i, j)| (i, j, least.sqrt()))
}

/// F with h = h₀ F for lattice vectors as rows. Non-periodic directions only rotate with the others.
fn deformation_gradient(reference: &Structure, structure: &Structure) -> Matrix3 {
    let from = reference.cell.completed(reference.periodic).reciprocal();
    let to = structure.cell.completed(structure.periodic).0;
    std::array::from_fn(|k| {
        std::array::from_fn(|l| from[0][k] * to[0][l] + from[1][k] * to[1][l] + from[2][k] * to[2][l])
    })
}

/// Square root of the smallest eigenvalue of F Fᵀ, by the trigonometric solution of the cubic (Smith, Commun.
/// ACM 4, 168 (1961)).
fn min_singular_value(f: &Matrix3) -> f64 {
    let c: Matrix3 = std::array::from_fn(|i| std::array::from_fn(|j| cell::dot(f[i], f[j])));
    let mean = (c[0][0] + c[1][1] + c[2][2]) / 3.0;
    let deviator: Matrix3 =
        std::array::from_fn(|i| std::array::from_fn(|j| if i == j { c[i][j] - mean } else { c[i][j] }));
    let p = (deviator.iter().map(|row| cell::dot(*row, *row)).sum::<f64>() / 6.0).sqrt();
    if p == 0.0 {
        return mean.sqrt();
    }
    let half_determinant = cell::dot(deviator[0], cell::cross(deviator[1], deviator[2])) / (2.0 * p * p * p);
    let angle = half_determinant.clamp(-1.0, 1.0).acos() / 3.0;
    let least = mean + 2.0 * p * (angle + 2.0 * std::f64::consts::PI / 3.0).cos();
    least.max(0.0).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn least_singular_value_of_known_deformations() {
        let stretch = [[1.1, 0.0, 0.0], [0.0, 0.93, 0.0], [0.0, 0.0, 1.02]];
        assert!((min_singular_value(&stretch) - 0.93).abs() < 1e-9);
        let (s, c) = 0.7_f64.sin_cos();
        let turned = stretch.map(|row| cell::row_times(row, &[[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]));
        assert!((min_singular_value(&turned) - 0.93).abs() < 1e-9);
        assert_eq!(min_singular_value(&[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), 1.0);
        // Simple shear g: s² − g s − 1 = 0 has the roots s_max and −s_min.
        let g: f64 = 0.3;
        let sheared = [[1.0, 0.0, 0.0], [g, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let exact = ((g * g + 4.0).sqrt() - g) / 2.0;
        assert!((min_singular_value(&sheared) - exact).abs() < 1e-9);
    }
}
