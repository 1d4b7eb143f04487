use super::*;
use crate::cell::{norm, sub};
use crate::extxyz::ExtxyzValue;

fn read_all(text: &str, types: &[&str]) -> Result<Vec<Frame>, DumpError> {
    LammpsDumpReader::new(text.as_bytes(), types.iter().map(|symbol| symbol.parse().unwrap()).collect())
        .collect()
}

const ORTHOGONAL: &str = "ITEM: UNITS\nmetal\nITEM: TIME\n0.5\nITEM: TIMESTEP\n500\nITEM: NUMBER OF ATOMS\n2\n\
    ITEM: BOX BOUNDS pp ff pp\n-1 3\n0 5\n2 8\nITEM: ATOMS id type xs ys zs element\n7 1 0.25 0.5 0.5 Mo\n2 2 0 0 0 O\n";

#[test]
fn scaled_coordinates_in_an_orthogonal_box() {
    let frames = read_all(&format!("{ORTHOGONAL}{ORTHOGONAL}"), &[]).unwrap();
    assert_eq!(frames.len(), 2);
    assert_eq!([frames[0].line, frames[1].line], [1, 16]);
    let Frame { structure, info, arrays, .. } = &frames[0];
    assert_eq!(structure.cell.0, [[4.0, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, 0.0, 6.0]]);
    assert_eq!(structure.periodic, [true, false, true]);
    assert_eq!(structure.formula(), "MoO");
    assert_eq!(structure.positions, [[0.0; 3], [1.0, 2.5, 3.0]], "in the order of their ids");
    assert_eq!(arrays["id"].reals().unwrap(), [2.0, 7.0]);
    assert_eq!(info["timestep"], ExtxyzValue::Int(500));
}

#[test]
fn types_become_elements() {
    let text = ORTHOGONAL.replace("element", "c_mine");
    let frame = read_all(&text, &["Al", "Ni"]).unwrap().remove(0);
    let symbols: Vec<_> = frame.structure.species.iter().map(|species| species.symbol()).collect();
    assert_eq!(symbols, ["Ni", "Al"]);
    let error = |types| read_all(&text, types).unwrap_err().to_string();
    assert!(error(&[]).starts_with("line 13: the dump has no column 'element'"), "{}", error(&[]));
    assert_eq!(error(&["Al"]), "line 15: found atom type 2, but elements are given for types 1 to 1");
}

/// The same crystal in a restricted triclinic and a general triclinic box.
#[test]
fn triclinic_boxes() {
    let atoms = "ITEM: ATOMS id element x y z\n1 Si 1 2 3\n";
    let head = "ITEM: TIMESTEP\n0\nITEM: NUMBER OF ATOMS\n1\n";
    // xlo, xhi = 1, 5; ylo, yhi = 2, 5; zlo, zhi = 3, 8; xy = -1.5, xz = 0.5, yz = -1.
    let restricted =
        format!("{head}ITEM: BOX BOUNDS xy xz yz pp pp pp\n-0.5 5.5 -1.5\n1 5 0.5\n3 8 -1\n{atoms}");
    let general =
        format!("{head}ITEM: BOX BOUNDS abc origin pp pp pp\n4 0 0 1\n-1.5 3 0 2\n0.5 -1 5 3\n{atoms}");
    for text in [restricted, general] {
        let structure = read_all(&text, &[]).unwrap().remove(0).structure;
        assert_eq!(structure.cell.0, [[4.0, 0.0, 0.0], [-1.5, 3.0, 0.0], [0.5, -1.0, 5.0]]);
        assert_eq!(structure.positions, [[0.0; 3]]);
    }
}

/// Snapshots that LAMMPS wrote (22 July 2025) of one triclinic cell with different columns (tests/data/lammps_dump.py).
#[test]
fn all_coordinates_of_lammps_are_the_same_positions() {
    let files = [
        include_str!("../../tests/data/lammps_x.dump"),
        include_str!("../../tests/data/lammps_xu.dump"),
        include_str!("../../tests/data/lammps_xs.dump"),
        include_str!("../../tests/data/lammps_xsu.dump"),
    ];
    let expected: Vec<Vec<Vec3>> =
        serde_json::from_str(include_str!("../../tests/data/lammps_dump.json")).unwrap();
    let (cell, positions) = (&expected[0], &expected[1]);
    for text in files {
        let frame = read_all(text, &["Si", "O"]).unwrap().remove(1);
        let structure = frame.structure;
        assert_eq!(frame.info["timestep"], ExtxyzValue::Int(20));
        for (vector, expected) in structure.cell.0.iter().zip(cell) {
            assert!(norm(sub(*vector, *expected)) < 1e-12);
        }
        assert_eq!(structure.formula(), "O4Si4");
        for (found, expected) in structure.positions.iter().zip(positions) {
            // Wrapped and unwrapped positions differ by lattice vectors.
            let shift = structure.cell.fractional(sub(*found, *expected));
            let residue = shift.map(|x| x - x.round());
            assert!(norm(structure.cell.cartesian(residue)) < 1e-9, "{found:?} {expected:?}");
        }
    }
}

#[test]
fn errors_tell_line_found_and_expected() {
    for (from, to, message) in [
        ("ITEM: UNITS", "2", "line 1: found '2', expected 'ITEM: ' and the name of a section"),
        ("metal", "lj", "line 2: found 'lj', expected units 'metal' or 'real', with lengths in Å"),
        ("500", "x", "line 6: found 'x', expected a time step"),
        ("ATOMS\n2", "ATOMS\n-2", "line 8: found '-2', expected a number of atoms"),
        ("pp ff pp", "pp ff", "line 12: found 'pp ff', expected 'pp', 'ff', 'ss' or other boundary flags"),
        (
            "pp ff pp",
            "ab cd pp pp pp",
            "line 12: found 'ab cd pp pp pp', expected 'xy xz yz', 'abc origin' or",
        ),
        ("-1 3", "-1 nan", "line 12: found '-1 nan', expected two finite numbers, the bounds of the box"),
        (
            "-1 3",
            "-1 -3",
            "line 12: found '-1 -3, 0 5, 2 8', expected lower bounds of the box below the upper ones",
        ),
        ("xs ys zs", "fx fy fz", "line 13: found the columns 'id type fx fy fz element', expected x y z"),
        (
            "type xs ys zs element",
            "kind xs ys zs charge",
            "line 13: found the columns 'id kind xs ys zs charge'",
        ),
        ("0 0 0 O", "0 0 0", "line 15: found '2 2 0 0 0', expected as many values as"),
        ("0 0 0 O", "0 0 inf O", "line 15: found 'inf', expected a finite coordinate"),
        ("0 0 0 O", "0 0 0 Xx", "line 15: unknown element 'Xx'"),
        ("\n7 1", "\n2 1", "line 1: two atoms have the id 2"),
        ("\n7 1", "\n7.5 1", "line 14: found '7.5', expected an integer id"),
        ("2 2 0 0 0 O\n", "", "line 15: the file ends here, expected an atom"),
        (
            "ITEM: NUMBER OF ATOMS\n2\n",
            "",
            "line 11: the snapshot has no section NUMBER OF ATOMS before its atoms",
        ),
    ] {
        assert!(ORTHOGONAL.contains(from), "{from}");
        let error = read_all(&ORTHOGONAL.replacen(from, to, 1), &[]).unwrap_err().to_string();
        assert!(error.starts_with(message), "{error}");
    }
    assert!(read_all("", &[]).unwrap().is_empty());
    let bytes =
        LammpsDumpReader::new(&b"ITEM: TIMESTEP\n\xff\xfe\n"[..], vec![]).next().unwrap().unwrap_err();
    assert!(bytes.to_string().starts_with("line 2: found bytes that are not text"), "{bytes}");
}

proptest::proptest! {
    #[test]
    fn arbitrary_text_never_panics(text in "(ITEM: |TIMESTEP|NUMBER OF ATOMS|BOX BOUNDS| pp| xy xz yz|ATOMS|\n|[0-9]| id| x y z| element|\\PC){0,80}") {
        let _ = read_all(&text, &["Al"]);
    }
}
