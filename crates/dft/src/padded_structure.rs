//! Structures in the form that codes with periodic basis functions need.

use atoms::cell::{self, scale};
use atoms::{NeighbourList, Structure, shortest_distance};

use crate::{CalculationResults, CalculationSize, Failure, FailureClass, k_mesh};

/// Minimum distance of atoms, Å. No campaign needs smaller ones, and some codes accept them silently.
const MIN_DISTANCE: f64 = 0.4;

/// A structure in a right-handed cell that is periodic in all directions.
#[derive(Clone, Debug)]
pub(crate) struct PaddedStructure {
    /// The structure, with the original species and positions.
    pub structure: Structure,
    /// Which lattice vectors were periodic in the original structure.
    repeats: [bool; 3],
}

impl PaddedStructure {
    /// Gives each non-periodic direction a lattice vector that is orthogonal to all others. Its length is the
    /// extent of the atoms plus `vacuum`, Å, rounded up to whole Å. Swaps the last two lattice vectors of a
    /// left-handed cell. Positions do not change.
    ///
    /// # Errors
    /// [`FailureClass::BadInput`] for an invalid structure or coinciding atoms.
    pub fn new(structure: &Structure, vacuum: f64) -> Result<Self, Failure> {
        structure.validate().map_err(|error| FailureClass::BadInput.with_message(error.to_string()))?;
        let padded = Self::unchecked(structure, vacuum);
        padded.check_distances()?;
        Ok(padded)
    }

    fn unchecked(structure: &Structure, vacuum: f64) -> Self {
        let mut repeats = structure.periodic;
        let mut cell = structure.cell.completed(repeats);
        for row in (0..3).filter(|row| !repeats[*row]) {
            let direction = cell.0[row];
            let along = structure.positions.iter().map(|position| cell::dot(*position, direction));
            let (least, most) = along
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(least, most), x| (least.min(x), most.max(x)));
            // Rounding to Å keeps the number of plane waves, and so the energy, independent of the positions.
            cell.0[row] = scale(direction, (most - least + vacuum - 1e-9).ceil());
        }
        if cell.signed_volume() < 0.0 {
            cell.0.swap(1, 2);
            repeats.swap(1, 2);
        }
        Self { structure: Structure { cell, periodic: [true; 3], ..structure.clone() }, repeats }
    }

    fn check_distances(&self) -> Result<(), Failure> {
        let structure = &self.structure;
        let mut neighbours = NeighbourList::new(MIN_DISTANCE, 0.0);
        neighbours
            .update(structure)
            .map_err(|error| FailureClass::BadInput.with_message(error.to_string()))?;
        let Some((i, j, distance)) = shortest_distance(structure, &neighbours) else { return Ok(()) };
        if distance >= MIN_DISTANCE {
            return Ok(());
        }
        let (first, second) = (structure.species[i], structure.species[j]);
        Err(FailureClass::BadInput.with_message(format!(
            "atoms {i} ({first}) and {j} ({second}) are {distance:.3} Å apart, less than {MIN_DISTANCE} Å"
        )))
    }

    /// The Γ-centred mesh of this spacing, Å⁻¹; one point along padded directions.
    pub fn mesh(&self, spacing: f64) -> [u32; 3] {
        k_mesh::gamma_centred(&self.structure.cell, self.repeats, spacing)
    }

    /// Removes the stress if a direction was padded, because it is undefined for the original structure.
    pub fn without_padding_stress(&self, calculated: CalculationResults) -> CalculationResults {
        let stress = calculated.stress.filter(|_| self.repeats == [true; 3]);
        CalculationResults { stress, ..calculated }
    }
}

/// The quantities that determine the cost, for this vacuum, k-point spacing and number of valence electrons.
pub(crate) fn size(structure: &Structure, vacuum: f64, k_spacing: f64, electrons: f64) -> CalculationSize {
    // Writing the input reports structures that cannot be calculated.
    let mesh = PaddedStructure::new(structure, vacuum).map_or([1; 3], |padded| padded.mesh(k_spacing));
    CalculationSize {
        atoms: structure.len(),
        electrons,
        k_points: mesh.iter().map(|n| *n as usize).product(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use atoms::Cell;

    fn oxygen(periodic: [bool; 3], cell: Cell) -> Structure {
        let species = vec!["O".parse().unwrap(); 2];
        Structure { species, positions: vec![[0.0; 3], [0.5, 0.0, 1.2]], cell, periodic }
    }

    #[test]
    fn open_directions_get_vacuum_and_one_k_point() {
        let slab = oxygen([true, true, false], Cell([[4.0, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0; 3]]));
        let padded = PaddedStructure::new(&slab, 10.0).unwrap();
        assert!((padded.structure.cell.0[2][2] - 12.0).abs() < 1e-12);
        assert_eq!(padded.structure.positions, slab.positions);
        assert_eq!(padded.mesh(0.5), [4, 3, 1]);
        let stress = Some([[1.0; 3]; 3]);
        assert_eq!(
            padded.without_padding_stress(CalculationResults { stress, ..Default::default() }).stress,
            None
        );

        let molecule = PaddedStructure::new(&oxygen([false; 3], Cell([[0.0; 3]; 3])), 8.0).unwrap();
        assert_eq!(molecule.structure.cell, Cell::orthorhombic(9.0, 8.0, 10.0));
        assert_eq!(molecule.mesh(0.1), [1; 3]);
    }

    #[test]
    fn a_left_handed_cell_changes_hands_with_its_mesh() {
        let left = oxygen([true; 3], Cell([[4.0, 0.0, 0.0], [0.0, 0.0, 9.0], [0.0, 5.0, 0.0]]));
        let padded = PaddedStructure::new(&left, 8.0).unwrap();
        assert_eq!(padded.structure.cell, Cell::orthorhombic(4.0, 5.0, 9.0));
        assert_eq!(padded.mesh(0.5), [4, 3, 2]);
    }

    #[test]
    fn coinciding_atoms_are_bad_input() {
        let mut structure = oxygen([true; 3], Cell::orthorhombic(4.0, 4.0, 4.0));
        structure.positions[1] = [3.9, 4.1, 0.0];
        let failure = PaddedStructure::new(&structure, 8.0).unwrap_err();
        assert_eq!(failure.class, FailureClass::BadInput);
        assert!(failure.message.contains("atoms 0 (O) and 1 (O) are 0.141 Å apart"), "{failure}");
        structure.positions[1] = [f64::NAN, 0.0, 0.0];
        assert_eq!(PaddedStructure::new(&structure, 8.0).unwrap_err().class, FailureClass::BadInput);
    }
}
