//! The shapes of batches. A compiled program is made for each shape, so there are few of them.

/// Numbers of structures, atoms and directed bonds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Shape {
    /// Structures.
    pub structures: usize,
    /// Atoms.
    pub atoms: usize,
    /// Directed bonds.
    pub bonds: usize,
}

impl Shape {
    /// The sum of two shapes.
    pub fn plus(self, other: Self) -> Self {
        Self {
            structures: self.structures + other.structures,
            atoms: self.atoms + other.atoms,
            bonds: self.bonds + other.bonds,
        }
    }

    /// The shape with room for a spare structure and a spare atom, which own what is padding: a power of two of structures, and the atoms
    /// and bonds of that many such structures, in steps of at most a quarter. So three structures have the shape of four, for which the
    /// program was compiled at the start.
    pub fn padded(self) -> Self {
        let structures = self.structures.next_power_of_two();
        let of_all = |count: usize| (count * structures).div_ceil(self.structures.max(1));
        Self {
            structures: structures + 1,
            atoms: step_above(of_all(self.atoms) + 1),
            bonds: step_above(of_all(self.bonds)),
        }
    }
}

/// The smallest of 1, 2, 4, 5, 6, 7, 8, 10, 12, 14, 16, 20, … that is not below `n`.
fn step_above(n: usize) -> usize {
    let power = n.next_power_of_two();
    let eighth = power / 8;
    // Below the next power of two there are 5, 6 and 7 eighths of it.
    (5..8).map(|k| k * eighth).find(|size| eighth > 0 && *size >= n).unwrap_or(power)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn padding_costs_at_most_a_quarter(n in 8_usize..1_000_000) {
            let size = step_above(n);
            prop_assert!(size >= n && 4 * size <= 5 * n + 4, "{n}: {size}");
            prop_assert_eq!(step_above(size), size);
        }

        #[test]
        fn any_number_of_structures_has_the_shape_of_a_power_of_two(n in 1_usize..100, atoms in 1_usize..300, bonds in 0_usize..9000) {
            let copies = |n: usize| Shape { structures: n, atoms: n * atoms, bonds: n * bonds }.padded();
            prop_assert_eq!(copies(n), copies(n.next_power_of_two()));
        }

        #[test]
        fn there_is_room_for_spare_atoms(structures in 1_usize..100, atoms in 1_usize..10_000, bonds in 0_usize..100_000) {
            let padded = Shape { structures, atoms, bonds }.padded();
            prop_assert!(padded.structures > structures && padded.atoms > atoms && padded.bonds >= bonds);
        }
    }
}
