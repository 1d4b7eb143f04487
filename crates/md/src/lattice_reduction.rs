//! Other lattice vectors for the same lattice, where those of a cell have become skew.

use atoms::cell::{add, dot, norm, scale, sub};
use atoms::{Structure, Vec3};

/// A cell is skew when its volume is less than this share of the product of its vectors' lengths.
///
/// A reduced lattice has at least 1/√2 (Minkowski-reduced, three dimensions; the face-centred cubic lattice has
/// exactly that), so cells near it are not reduced back and forth.
const SKEW: f64 = 0.5;

/// More steps than any reduction needs: each shortens a vector.
const MAX_STEPS: usize = 1000;

/// Replaces the periodic lattice vectors of a skew cell by short ones of the same lattice; returns whether it did.
///
/// The new vectors are integer combinations of the old ones (Semaev, Lect. Notes Comput. Sci. 2146, 181 (2001)), with the
/// same volume and handedness, so all distances, forces and the strain rate stay. Atoms are wrapped into the new cell:
/// in a cell that flows, as that of a liquid does, images that are far apart move apart without limit.
pub(crate) fn reduce_if_skew(structure: &mut Structure) -> bool {
    if !is_skew(structure) {
        return false;
    }
    let periodic: Vec<usize> = (0..3).filter(|k| structure.periodic[*k]).collect();
    let rows = &mut structure.cell.0;
    let mut vectors: Vec<Vec3> = periodic.iter().map(|k| rows[*k]).collect();
    for _ in 0..MAX_STEPS {
        let shortened = (0..vectors.len()).any(|k| shorten(&mut vectors, k));
        if !shortened {
            break;
        }
    }
    periodic.iter().zip(vectors).for_each(|(k, vector)| rows[*k] = vector);
    wrap(structure);
    true
}

/// Moves each atom by lattice vectors into the cell.
fn wrap(structure: &mut Structure) {
    let lattice = structure.cell.completed(structure.periodic);
    let reciprocal = lattice.reciprocal();
    for position in &mut structure.positions {
        let image =
            |k: usize| if structure.periodic[k] { dot(reciprocal[k], *position).floor() } else { 0.0 };
        *position = sub(*position, lattice.cartesian(std::array::from_fn(image)));
    }
}

/// Whether the volume is less than half of the product of the lattice vectors' lengths.
pub(crate) fn is_skew(structure: &Structure) -> bool {
    let lattice = structure.cell.completed(structure.periodic);
    lattice.volume() < SKEW * lattice.0.iter().map(|a| norm(*a)).product::<f64>()
}

/// Subtracts from vector `k` a combination of the others, if that makes it shorter.
fn shorten(vectors: &mut [Vec3], k: usize) -> bool {
    let own = vectors[k];
    let others: Vec<Vec3> =
        (0..vectors.len()).filter(|other| *other != k).map(|other| vectors[other]).collect();
    let mut candidates = Vec::new();
    for other in &others {
        candidates.push(scale(*other, (dot(own, *other) / dot(*other, *other)).round()));
    }
    if let [a, b] = others[..] {
        for signs in [[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]] {
            candidates.push(add(scale(a, signs[0]), scale(b, signs[1])));
        }
    }
    let shorter = candidates.into_iter().map(|combination| sub(own, combination));
    let Some(shortest) = shorter.min_by(|a, b| dot(*a, *a).total_cmp(&dot(*b, *b))) else { return false };
    // A margin, so that rounding does not exchange vectors of equal length for ever.
    let is_shorter = dot(shortest, shortest) < (1.0 - 1e-9) * dot(own, own);
    if is_shorter {
        vectors[k] = shortest;
    }
    is_shorter
}

#[cfg(test)]
mod tests {
    use super::*;
    use atoms::Cell;
    use proptest::prelude::*;

    fn structure(cell: Cell, periodic: [bool; 3]) -> Structure {
        Structure { species: vec!["Al".parse().unwrap()], positions: vec![[7.0, -8.0, 9.0]], cell, periodic }
    }

    /// `rows` times integer shears.
    fn sheared(mut rows: [Vec3; 3], shears: &[(usize, usize, i32)]) -> Cell {
        for &(k, other, n) in shears {
            rows[k] = add(rows[k], scale(rows[(k + 1 + other) % 3], f64::from(n)));
        }
        Cell(rows)
    }

    proptest! {
        #[test]
        fn reduced_cells_span_the_same_lattice(
            entries in prop::array::uniform9(-1.0..1.0),
            shears in prop::collection::vec((0_usize..3, 0_usize..2, -3..=3), 0..8),
        ) {
            let e: [f64; 9] = entries;
            let rows = [[5.0 + e[0], e[1], e[2]], [e[3], 4.0 + e[4], e[5]], [e[6], e[7], 6.0 + e[8]]];
            let cell = sheared(rows, &shears);
            let mut reduced = structure(cell, [true; 3]);
            let was_skew = is_skew(&reduced);
            prop_assert_eq!(reduce_if_skew(&mut reduced), was_skew);
            prop_assert!(!is_skew(&reduced));
            let volume = Cell(rows).signed_volume();
            prop_assert!((reduced.cell.signed_volume() / volume - 1.0).abs() < 1e-9);
            for row in reduced.cell.0 {
                for coefficient in Cell(rows).fractional(row) {
                    prop_assert!((coefficient - coefficient.round()).abs() < 1e-7);
                }
            }
            let moved = Cell(rows).fractional(sub([7.0, -8.0, 9.0], reduced.positions[0]));
            prop_assert!(moved.iter().all(|x| (x - x.round()).abs() < 1e-7));
            if was_skew {
                let inside = reduced.cell.fractional(reduced.positions[0]);
                prop_assert!(inside.iter().all(|x| (-1e-9..1.0 + 1e-9).contains(x)));
                let product: f64 = reduced.cell.0.iter().map(|a| norm(*a)).product();
                prop_assert!(product <= 2_f64.sqrt() * volume * (1.0 + 1e-8));
            }
        }
    }

    /// Each pair is at 120°, nearly in a plane: no pair can be shortened, but their sum is short.
    #[test]
    fn three_vectors_almost_in_a_plane_are_reduced() {
        let h = 3_f64.sqrt() / 2.0;
        let cell = Cell([[1.0, 0.0, 0.05], [-0.5, h, 0.05], [-0.5, -h, 0.05]]);
        let mut reduced = structure(cell, [true; 3]);
        assert!(reduce_if_skew(&mut reduced));
        let shortest = reduced.cell.0.iter().map(|a| norm(*a)).fold(f64::INFINITY, f64::min);
        assert!((shortest - 0.15).abs() < 1e-12 && !is_skew(&reduced));
    }

    #[test]
    fn slabs_reduce_in_their_plane_and_good_cells_stay() {
        let mut slab =
            structure(Cell([[4.0, 0.0, 0.0], [9.0, 4.0, 0.0], [1.0, 2.0, 30.0]]), [true, true, false]);
        assert!(reduce_if_skew(&mut slab));
        assert_eq!(slab.cell.0, [[4.0, 0.0, 0.0], [1.0, 4.0, 0.0], [1.0, 2.0, 30.0]]);
        let primitive = Cell([[0.0, 2.0, 2.0], [2.0, 0.0, 2.0], [2.0, 2.0, 0.0]]);
        assert!(!reduce_if_skew(&mut structure(primitive, [true; 3])));
        assert!(!reduce_if_skew(&mut structure(Cell([[1.0, 9.0, 0.0]; 3]), [false; 3])));
        assert!(!reduce_if_skew(&mut structure(Cell([[1.0, 9.0, 0.0]; 3]), [true, false, false])));
    }
}
