//! Each guard on both sides of its limit.

use atoms::Cell;
use atoms::cell::Matrix3;

use super::*;

/// An atom of Si and one of O, 2 Å apart.
fn structure(cell: Matrix3) -> Structure {
    let species = ["Si", "O"].map(|symbol| symbol.parse().unwrap());
    Structure {
        species: species.to_vec(),
        positions: vec![[0.1, 0.0, 0.0], [2.1, 0.0, 0.0]],
        cell: Cell(cell),
        periodic: [true; 3],
    }
}

fn box_of(a: f64, b: f64, c: f64) -> Structure {
    structure(Cell::orthorhombic(a, b, c).0)
}

fn guard(text: &str) -> LabelGuard {
    serde_json::from_str(text).unwrap()
}

fn refused(guard_text: &str, structure: &Structure) -> bool {
    guard(guard_text).rejects(structure).is_some()
}

#[test]
fn unset_limits_reject_nothing() {
    assert_eq!(LabelGuard::default().rejects(&box_of(0.5, 100.0, 3.0)), None);
    assert_eq!(guard("{}"), LabelGuard::default());
    assert_eq!(LabelGuard::default().invalid_setting(), None);
}

#[test]
fn bond_limits_apply_per_pair_and_across_the_boundary() {
    let apart = box_of(9.0, 9.0, 9.0);
    assert!(refused(r#"{ "min_bond_lengths": { "O-Si": 2.01 } }"#, &apart));
    assert!(refused(r#"{ "min_bond_lengths": { "Si-O": 2.01 } }"#, &apart));
    assert!(!refused(r#"{ "min_bond_lengths": { "Si-O": 1.99, "Si-Si": 8.0, "O-O": 8.9 } }"#, &apart));
    // 1.5 Å through the boundary, and an atom to its own image.
    assert!(refused(r#"{ "min_bond_lengths": { "Si-O": 1.6 } }"#, &box_of(3.5, 9.0, 9.0)));
    assert!(refused(r#"{ "min_bond_lengths": { "O-O": 3.6 } }"#, &box_of(3.5, 9.0, 9.0)));
    let reason = guard(r#"{ "min_bond_lengths": { "Si-O": 2.5 } }"#).rejects(&apart).unwrap();
    assert!(reason.contains("2.000 Å") && reason.contains("O-Si is 2.5"), "{reason}");
    assert!(serde_json::from_str::<LabelGuard>(r#"{ "min_bond_lengths": { "Si": 2.0 } }"#).is_err());
}

#[test]
fn cell_shapes_have_limits() {
    let long = box_of(4.0, 5.0, 12.0);
    assert!(refused(r#"{ "min_height": 4.1 }"#, &long) && !refused(r#"{ "min_height": 3.9 }"#, &long));
    assert!(refused(r#"{ "max_edge_ratio": 2.9 }"#, &long));
    assert!(!refused(r#"{ "max_edge_ratio": 3.1 }"#, &long));
    // 45° and 135° are equivalent.
    for x in [5.0, -5.0] {
        let sheared = structure([[6.0, 0.0, 0.0], [x, 5.0, 0.0], [0.0, 0.0, 6.0]]);
        assert!(refused(r#"{ "min_angle": 46 }"#, &sheared), "{x}");
        assert!(!refused(r#"{ "min_angle": 44 }"#, &sheared), "{x}");
        assert!(refused(r#"{ "min_height": 4.3 }"#, &sheared), "6 sin 45° = 4.24 Å");
    }
    // Non-periodic directions have no shape.
    let slab = Structure { periodic: [true, true, false], ..long };
    assert!(!refused(r#"{ "max_edge_ratio": 2.9, "min_volume_per_atom": 1e6 }"#, &slab));
}

#[test]
fn volumes_and_atom_counts_have_limits() {
    // 60 Å³ for two atoms.
    let structure = box_of(3.0, 4.0, 5.0);
    for (text, expected) in [
        (r#"{ "min_volume_per_atom": 30.1 }"#, true),
        (r#"{ "min_volume_per_atom": 29.9 }"#, false),
        (r#"{ "max_volume_per_atom": 29.9 }"#, true),
        (r#"{ "max_volume_per_atom": 30.1 }"#, false),
        (r#"{ "max_atoms": 1 }"#, true),
        (r#"{ "max_atoms": 2 }"#, false),
    ] {
        assert_eq!(refused(text, &structure), expected, "{text}");
    }
}

#[test]
fn impossible_limits_are_rejected() {
    for (text, key) in [
        (r#"{ "min_bond_lengths": { "Si-O": -1.0 } }"#, "label.guard.min_bond_lengths"),
        (r#"{ "min_angle": 91 }"#, "label.guard.min_angle"),
        (r#"{ "duplicate_tolerance": 1.5 }"#, "label.guard.duplicate_tolerance"),
        (r#"{ "max_cost": 0 }"#, "label.guard.max_cost"),
    ] {
        assert_eq!(guard(text).invalid_setting().unwrap().0, key);
    }
}

#[test]
fn features_are_near_if_those_of_every_atom_are() {
    let own = [1.0, 0.0, 0.0, 2.0];
    assert!(is_near(&own, &[1.0, 0.09, 0.0, 2.1], 2, 0.1));
    assert!(!is_near(&own, &[1.0, 0.11, 0.0, 2.0], 2, 0.1), "one atom is enough");
    assert!(!is_near(&own, &[1.0, 0.0], 2, 0.1) && !is_near(&[], &[], 2, 0.1));
}
