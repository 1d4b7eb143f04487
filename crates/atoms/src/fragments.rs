//! Fragments of a structure.

use crate::{ElementPair, NeighbourList, Species, Structure, StructureError};

/// Two atoms are bonded within this multiple of the sum of their covalent radii, as in `grace_uq hal`.
pub const BOND_FACTOR: f64 = 1.25;

/// Number of fragments: sets of atoms that bonds join ([`BOND_FACTOR`]). A dilute crystal, whose atoms are all far apart, has
/// many fragments without anything being broken.
///
/// # Errors
/// A structure without neighbours: an impossible cell, or positions that are not finite.
pub fn fragments(structure: &Structure) -> Result<usize, StructureError> {
    let radius = structure.species.iter().map(|species| species.covalent_radius()).fold(0.0, f64::max);
    let mut neighbours = NeighbourList::new(2.0 * BOND_FACTOR * radius, 0.0);
    neighbours.update(structure)?;
    let longest = |a: Species, b: Species| BOND_FACTOR * ElementPair::new(a, b).covalent_radii();
    let (mut seen, mut waiting, mut bonds) = (vec![false; structure.len()], Vec::new(), Vec::new());
    let mut fragments = 0;
    for first in 0..structure.len() {
        if seen[first] {
            continue;
        }
        fragments += 1;
        seen[first] = true;
        waiting.push(first);
        while let Some(i) = waiting.pop() {
            neighbours.bonds_within(structure, i, neighbours.cutoff(), &mut bonds);
            for bond in &bonds {
                let j = bond.atom as usize;
                if !seen[j] && bond.r < longest(structure.species[i], structure.species[j]) {
                    seen[j] = true;
                    waiting.push(j);
                }
            }
        }
    }
    Ok(fragments)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Cell;

    /// Atoms on a line at these places, Å.
    fn line(atoms: &[(&str, f64)], cell: f64, periodic: bool) -> Structure {
        Structure {
            species: atoms.iter().map(|(symbol, _)| symbol.parse().unwrap()).collect(),
            positions: atoms.iter().map(|(_, x)| [*x, 0.0, 0.0]).collect(),
            cell: Cell::orthorhombic(cell, 20.0, 20.0),
            periodic: [periodic, false, false],
        }
    }

    #[test]
    fn bonds_join_atoms() {
        // Al–Al up to 3.025 Å, Al–O up to 2.3375 Å, O–O up to 1.65 Å.
        let mixed = |last: f64| [("Al", 0.0), ("O", 2.3), ("Al", 4.6), ("Al", 7.6), ("O", last)];
        assert_eq!(fragments(&line(&mixed(9.9), 40.0, false)).unwrap(), 1);
        assert_eq!(fragments(&line(&mixed(9.95), 40.0, false)).unwrap(), 2);
        let oxygen = [("O", 0.0), ("O", 1.7), ("O", 3.3)];
        assert_eq!(fragments(&line(&oxygen, 40.0, false)).unwrap(), 2);
        // Through the boundary of the cell.
        let apart = [("Al", 0.5), ("Al", 9.0)];
        assert_eq!(fragments(&line(&apart, 11.0, true)).unwrap(), 1);
        assert_eq!(fragments(&line(&apart, 11.0, false)).unwrap(), 2);
    }
}
