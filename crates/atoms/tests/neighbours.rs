//! The linked-cell list against a brute-force search over all images.

use atoms::{Cell, Neighbour, NeighbourList, Species, Structure, StructureError, Vec3, shortest_distance};
use proptest::prelude::*;

/// All directed pairs within `reach`, in canonical order, by testing every relevant image.
fn all_pairs(structure: &Structure, reach: f64) -> Vec<Vec<Neighbour>> {
    let lattice = structure.cell.completed(structure.periodic);
    let reciprocal = lattice.reciprocal();
    (0..structure.len())
        .map(|i| {
            let mut found = Vec::new();
            for j in 0..structure.len() {
                let d = atoms::cell::sub(structure.positions[j], structure.positions[i]);
                let range = |k: usize| {
                    // |f + n| ≤ reach / height for the fractional coordinate f of d.
                    let (f, wide) =
                        (atoms::cell::dot(d, reciprocal[k]), reach * atoms::cell::norm(reciprocal[k]) + 1e-6);
                    if structure.periodic[k] {
                        (-f - wide).floor() as i32..=(-f + wide).ceil() as i32
                    } else {
                        0..=0
                    }
                };
                for a in range(0) {
                    for b in range(1) {
                        for c in range(2) {
                            let neighbour = Neighbour { atom: j as u32, image: [a, b, c] };
                            let r = atoms::cell::norm(neighbour.displacement(structure, i));
                            if r <= reach && (i != j || [a, b, c] != [0; 3]) {
                                found.push(neighbour);
                            }
                        }
                    }
                }
            }
            found
        })
        .collect()
}

fn within(structure: &Structure, list: &NeighbourList, cutoff: f64) -> Vec<Vec<Neighbour>> {
    (0..structure.len())
        .map(|i| {
            let mut kept = list.neighbours_of(i).to_vec();
            kept.retain(|n| atoms::cell::norm(n.displacement(structure, i)) <= cutoff);
            kept
        })
        .collect()
}

fn aluminium(positions: Vec<Vec3>, cell: Cell, periodic: [bool; 3]) -> Structure {
    let species = vec!["Al".parse::<Species>().unwrap(); positions.len()];
    Structure { species, positions, cell, periodic }
}

fn matrix(range: f64) -> impl Strategy<Value = [[f64; 3]; 3]> {
    prop::array::uniform3(prop::array::uniform3(-range..range))
}

/// Triclinic cells with edges of about `edge`, any periodicity, and atoms up to `far` cells outside.
fn structures(edge: f64, atoms: usize, far: f64) -> impl Strategy<Value = Structure> {
    let positions = prop::collection::vec(prop::array::uniform3(-far..far + 1.0), 1..=atoms);
    (matrix(0.35 * edge), positions, prop::array::uniform3(any::<bool>()), any::<bool>()).prop_map(
        move |(tilt, fractional, periodic, zero)| {
            let mut cell = Cell(tilt);
            (0..3).for_each(|k| cell.0[k][k] += edge);
            let positions = fractional.iter().map(|f| cell.cartesian(*f)).collect();
            for k in (0..3).filter(|k| zero && !periodic[*k]) {
                cell.0[k] = [0.0; 3];
            }
            aluminium(positions, cell, periodic)
        },
    )
}

fn is_complete(structure: &Structure, cutoff: f64, skin: f64) -> Result<(), TestCaseError> {
    let mut list = NeighbourList::new(cutoff, skin);
    match list.update(structure) {
        Err(StructureError::CellVolume(_)) => return Ok(()),
        built => prop_assert_eq!(built, Ok(true)),
    }
    prop_assert_eq!(list.update(structure), Ok(false));
    for (i, expected) in all_pairs(structure, cutoff + skin).iter().enumerate() {
        prop_assert_eq!(list.neighbours_of(i), expected.as_slice());
    }
    each_pair_comes_once_and_stands_at_its_site(structure, &list)
}

fn each_pair_comes_once_and_stands_at_its_site(
    structure: &Structure,
    list: &NeighbourList,
) -> Result<(), TestCaseError> {
    let mut sites = vec![[9.0; 3]; 3];
    list.site_positions(structure, &mut sites);
    prop_assert_eq!(&sites[..structure.len()], &structure.positions[..]);
    let mut pairs = 0;
    for i in 0..structure.len() {
        let own = Neighbour { atom: i as u32, image: [0; 3] };
        let later: Vec<Neighbour> =
            list.neighbours_of(i).iter().copied().filter(|neighbour| *neighbour > own).collect();
        prop_assert_eq!(list.later_neighbours_of(i), later.as_slice());
        prop_assert_eq!(list.later_sites_of(i).len(), later.len());
        for (neighbour, site) in later.iter().zip(list.later_sites_of(i)) {
            let d = atoms::cell::sub(sites[*site as usize], structure.positions[i]);
            let off = atoms::cell::norm(atoms::cell::sub(d, neighbour.displacement(structure, i)));
            prop_assert!(off < 1e-10, "site {} of atom {} is off by {} Å", site, i, off);
        }
        pairs += later.len();
    }
    let directed: usize = (0..structure.len()).map(|i| list.neighbours_of(i).len()).sum();
    prop_assert_eq!(2 * pairs, directed);
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 192, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn large_cells_match_all_pairs(structure in structures(14.0, 60, 3.0)) {
        is_complete(&structure, 4.0, 0.5)?;
    }

    #[test]
    fn medium_cells_match_all_pairs(structure in structures(6.0, 12, 1.0)) {
        is_complete(&structure, 5.0, 0.0)?;
    }

    #[test]
    fn far_strewn_atoms_match_all_pairs(structure in structures(10.0, 20, 300.0)) {
        is_complete(&structure, 5.0, 1.0)?;
    }

    /// After any displacement and strain the list is complete within the cutoff, rebuilt or not.
    #[test]
    fn skin_keeps_the_list_complete(
        structure in structures(9.0, 16, 2.0),
        moves in prop::collection::vec((matrix(0.02), prop::collection::vec(prop::array::uniform3(-0.2..0.2_f64), 16)), 6),
    ) {
        let (cutoff, mut structure) = (4.5, structure);
        let mut list = NeighbourList::new(cutoff, 1.0);
        prop_assume!(list.update(&structure).is_ok());
        for (strain, displacements) in moves {
            let mut f = strain;
            (0..3).for_each(|k| f[k][k] += 1.0);
            structure.cell.0 = structure.cell.0.map(|a| atoms::cell::row_times(a, &f));
            for (r, u) in structure.positions.iter_mut().zip(displacements) {
                *r = atoms::cell::add(atoms::cell::row_times(*r, &f), u);
            }
            list.update(&structure).unwrap();
            prop_assert_eq!(within(&structure, &list, cutoff), all_pairs(&structure, cutoff));
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn cells_much_smaller_than_the_cutoff_match_all_pairs(structure in structures(1.5, 2, 2.0)) {
        is_complete(&structure, 6.0, 0.3)?;
    }
}

#[test]
fn face_centred_cubic_shells() {
    let a = 4.05;
    let primitive = Cell([[0.0, a / 2.0, a / 2.0], [a / 2.0, 0.0, a / 2.0], [a / 2.0, a / 2.0, 0.0]]);
    let structure = aluminium(vec![[100.0, -30.0, 7.0]], primitive, [true; 3]);
    let mut list = NeighbourList::new(1.3 * a, 0.0);
    list.update(&structure).unwrap();
    // 12 at a/√2, 6 at a, 24 at a √(3/2).
    assert_eq!(list.neighbours_of(0).len(), 42);
    let mut bonds = Vec::new();
    list.bonds_within(&structure, 0, 0.9 * a, &mut bonds);
    assert_eq!(bonds.len(), 12);
    assert!(bonds.iter().all(|bond| (bond.r - a / 2.0_f64.sqrt()).abs() < 1e-12));
    let (i, j, r) = shortest_distance(&structure, &list).unwrap();
    assert_eq!((i, j), (0, 0));
    assert!((r - a / 2.0_f64.sqrt()).abs() < 1e-12);
}

#[test]
fn the_list_is_kept_while_the_skin_allows_and_not_longer() {
    let grid = (0..64).map(|n| [3.0 * (n % 4) as f64, 3.0 * (n / 4 % 4) as f64, 3.0 * (n / 16) as f64]);
    let start = aluminium(grid.collect(), Cell::orthorhombic(12.0, 12.0, 12.0), [true; 3]);
    let mut list = NeighbourList::new(5.0, 1.0);
    assert_eq!(list.update(&start), Ok(true));
    let mut moved = start.clone();
    moved.positions[5][0] += 0.49;
    assert_eq!(list.update(&moved), Ok(false));
    moved.positions[5][0] += 0.02;
    assert_eq!(list.update(&moved), Ok(true));

    // Isotropic compression by s moves atoms far from the origin a lot, but only s · reach matters.
    let shrunk = |s: f64| {
        let mut structure = moved.clone();
        structure.cell.0 = structure.cell.0.map(|a| a.map(|x| s * x));
        structure.positions.iter_mut().flatten().for_each(|x| *x *= s);
        structure
    };
    assert_eq!(list.clone().update(&shrunk(0.834)), Ok(false));
    assert_eq!(list.clone().update(&shrunk(0.833)), Ok(true));

    let mut other = moved.clone();
    other.species[0] = "Si".parse().unwrap();
    assert_eq!(list.clone().update(&other), Ok(true));
    other.periodic[2] = false;
    assert_eq!(list.update(&other), Ok(true));
}

#[test]
fn absurd_structures_are_refused_and_leave_an_empty_list() {
    let mut list = NeighbourList::new(6.0, 1.0);
    let cube = |edge: f64| aluminium(vec![[0.0; 3]], Cell::orthorhombic(edge, edge, edge), [true; 3]);
    assert_eq!(list.update(&cube(3.0)), Ok(true));
    assert!(matches!(list.update(&cube(0.2)), Err(StructureError::Crowded { atom: 0, .. })));
    assert!(list.is_empty());
    assert!(matches!(list.update(&cube(1e-3)), Err(StructureError::CellThin { .. })));
    assert!(matches!(list.update(&cube(0.0)), Err(StructureError::CellVolume(_))));
    assert_eq!(list.update(&cube(f64::NAN)), Err(StructureError::CellEntry));
    let far = aluminium(vec![[0.0; 3], [1e12, 0.0, 0.0]], Cell::orthorhombic(9.0, 9.0, 9.0), [false; 3]);
    assert!(matches!(list.update(&far), Err(StructureError::FarAway { atom: 1, .. })));
    let heap = aluminium(vec![[0.0; 3]; 30_000], Cell::orthorhombic(9.0, 9.0, 9.0), [false; 3]);
    assert!(matches!(list.update(&heap), Err(StructureError::Crowded { .. })));
    let mut broken = aluminium(vec![[0.0; 3], [2.0; 3]], Cell::orthorhombic(9.0, 9.0, 9.0), [true; 3]);
    list.update(&broken).unwrap();
    broken.positions[0][1] = f64::NAN;
    assert_eq!(list.update(&broken), Err(StructureError::Position(0)));
    assert!(list.is_empty());
    broken.positions.clear();
    assert!(matches!(list.update(&broken), Err(StructureError::Length { .. })));
}

/// A list has another number after each build, which no other list has; a copy has the same neighbours and the same number.
#[test]
fn each_build_has_a_number() {
    let structure = aluminium(vec![[0.0; 3], [2.8, 0.0, 0.0]], Cell([[0.0; 3]; 3]), [false; 3]);
    let [mut list, mut other] = [0, 1].map(|_| NeighbourList::new(4.0, 0.5));
    assert_eq!(list.build_number(), 0);
    assert!(list.update(&structure).unwrap() && other.update(&structure).unwrap());
    let first = list.build_number();
    assert!(first != 0 && other.build_number() != first && list.clone().build_number() == first);
    assert!(!list.update(&structure).unwrap() && list.build_number() == first);
    let mut moved = structure.clone();
    moved.positions[1][0] = 3.5;
    assert!(list.update(&moved).unwrap() && list.build_number() != first);
    moved.positions[1][0] = f64::NAN;
    assert!(list.update(&moved).is_err() && list.build_number() == 0);
}
