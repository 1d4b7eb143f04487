//! Supercells: a cell repeated along its periodic directions.

use std::fmt;

use crate::cell::{self, Cell};
use crate::structure::Structure;

/// How many times a cell stands side by side along each lattice vector.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Repetition(pub [u32; 3]);

/// Heights that are shorter by less than this fraction count as long enough: a cell of 4 Å fits 8 Å twice.
const ROUNDING: f64 = 1e-9;

impl Repetition {
    /// The cell alone.
    pub const ONE: Self = Self([1; 3]);

    /// The repetition that makes `structure` large enough: along each periodic direction, opposite faces are at least
    /// `min_height` apart, Å. Then the direction whose faces are closest is repeated once more, the first if several are
    /// equally close, until there are `min_atoms` atoms. A structure without periodic directions stays as it is.
    ///
    /// `structure` must be valid.
    pub fn for_size(structure: &Structure, min_atoms: usize, min_height: f64) -> Self {
        let heights = structure.cell.completed(structure.periodic).heights();
        let fits = |k: usize| (min_height / heights[k] * (1.0 - ROUNDING)).ceil().max(1.0) as u32;
        let mut times = std::array::from_fn(|k| if structure.periodic[k] { fits(k) } else { 1 });
        let is_small =
            |times: [u32; 3]| Self(times).cells().saturating_mul(structure.len() as u64) < min_atoms as u64;
        while is_small(times) {
            let height = |k: &usize| heights[*k] * f64::from(times[*k]);
            let periodic = (0..3).filter(|k| structure.periodic[*k]);
            let shorter = |a, b| if height(&b) < height(&a) * (1.0 - ROUNDING) { b } else { a };
            let Some(thinnest) = periodic.reduce(shorter) else { break };
            times[thinnest] += 1;
        }
        Self(times)
    }

    /// Number of cells.
    pub fn cells(self) -> u64 {
        self.0.iter().fold(1, |cells, times| cells.saturating_mul((*times).into()))
    }
}

impl fmt::Display for Repetition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [a, b, c] = self.0;
        write!(f, "{a} × {b} × {c}")
    }
}

impl Structure {
    /// The supercell. Its atoms are those of the structure, in their order, followed by those of each further cell.
    pub fn repeated(&self, repetition: Repetition) -> Self {
        let [a, b, c] = repetition.0.map(|times| times as i32);
        let images = (0..a).flat_map(|i| (0..b).flat_map(move |j| (0..c).map(move |k| [i, j, k])));
        let (mut species, mut positions) = (Vec::new(), Vec::new());
        for shift in images.map(|image| self.cell.translation(image)) {
            species.extend_from_slice(&self.species);
            positions.extend(self.positions.iter().map(|r| cell::add(*r, shift)));
        }
        let rows = std::array::from_fn(|k| cell::scale(self.cell.0[k], f64::from(repetition.0[k])));
        Self { species, positions, cell: Cell(rows), periodic: self.periodic }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::NeighbourList;

    /// Two atoms in a cell with the heights 4, 3 and 5 Å.
    fn skewed(periodic: [bool; 3]) -> Structure {
        Structure {
            species: vec!["Al".parse().unwrap(), "O".parse().unwrap()],
            positions: vec![[0.1, 0.2, 0.3], [2.1, 1.6, 2.6]],
            cell: Cell([[4.0, 0.0, 0.0], [1.5, 3.0, 0.0], [0.0, 0.0, 5.0]]),
            periodic,
        }
    }

    fn times(periodic: [bool; 3], min_atoms: usize, min_height: f64) -> [u32; 3] {
        Repetition::for_size(&skewed(periodic), min_atoms, min_height).0
    }

    #[test]
    fn periodic_directions_are_repeated_until_the_cell_is_large_enough() {
        let all = [true; 3];
        // The first lattice vector and the second are not orthogonal: the height along the first is 4·3/√(1.5² + 3²) Å.
        assert_eq!(times(all, 1, 0.0), [1, 1, 1]);
        assert_eq!(times(all, 1, 7.0), [2, 3, 2]);
        assert_eq!(times(all, 1, 10.0), [3, 4, 2]);
        assert_eq!(times(all, 3, 0.0), [1, 2, 1]);
        assert_eq!(times(all, 5, 0.0), [2, 2, 1]);
        assert_eq!(times(all, 9, 0.0), [2, 2, 2]);
        assert_eq!(times(all, 25, 7.0), [3, 3, 2]);
        // Only what is periodic is repeated.
        assert_eq!(times([true, false, true], 9, 7.0), [3, 1, 2]);
        assert_eq!(times([false, false, true], 7, 0.0), [1, 1, 4]);
        assert_eq!(times([false; 3], 100, 50.0), [1, 1, 1]);
    }

    #[test]
    fn a_height_that_fits_exactly_is_enough() {
        let cube = |a: f64| Structure { cell: Cell::orthorhombic(a, a, a), ..skewed([true; 3]) };
        for a in [4.05, 2.7, 3.3, 3.61] {
            for times in 1..8 {
                let found = Repetition::for_size(&cube(a), 1, a * f64::from(times));
                assert_eq!(found.0, [times; 3], "{a}");
            }
        }
        // Equal heights grow from the first on.
        assert_eq!(Repetition::for_size(&cube(4.05), 7, 0.0).0, [2, 2, 1]);
    }

    #[test]
    fn a_supercell_has_the_environments_of_its_cell() {
        for (periodic, repetition) in [([true; 3], [2, 3, 1]), ([true, false, true], [2, 1, 2])] {
            let cell = skewed(periodic);
            let large = cell.repeated(Repetition(repetition));
            let cells = Repetition(repetition).cells() as usize;
            assert_eq!(large.len(), cells * cell.len());
            assert_eq!(large.positions[..2], cell.positions);
            assert_eq!(large.periodic, periodic);
            large.validate().unwrap();
            let distances = |structure: &Structure, i: usize| {
                let mut neighbours = NeighbourList::new(6.0, 0.0);
                neighbours.update(structure).unwrap();
                let mut bonds = Vec::new();
                neighbours.bonds_within(structure, i, 6.0, &mut bonds);
                let mut found: Vec<_> =
                    bonds.iter().map(|bond| (structure.species[bond.atom as usize], bond.r)).collect();
                found.sort_by(|a, b| a.1.total_cmp(&b.1));
                found
            };
            for i in 0..large.len() {
                let (found, expected) = (distances(&large, i), distances(&cell, i % cell.len()));
                assert_eq!(found.len(), expected.len());
                for ((_, a), (_, b)) in found.iter().zip(&expected) {
                    assert!((a - b).abs() < 1e-12, "{a} {b}");
                }
            }
        }
    }
}
