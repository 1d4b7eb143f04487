use proptest::prelude::*;

use super::*;
use crate::cell::{norm, sub};

fn read(text: &str) -> Result<Frame, PoscarError> {
    read_poscar(text.as_bytes())
}

const SELECTIVE: &str = "Gallium arsenide, it says\n  2.0 ! scale\n 0 1 1\n 1 0 1\n 1 1 0\n Ga_d/1f2e As\n 1 1 ! counts\n\
    Selective dynamics\nDirect\n 0 0 0 T T F Ga\n 0.25 0.25 0.25 .FALSE. .true. T\n\n  0.0 0.1 0.2\n  0.3 x y\n";

#[test]
fn direct_coordinates_with_selective_dynamics() {
    let frame = read(SELECTIVE).unwrap();
    assert_eq!(frame.structure.formula(), "AsGa");
    assert_eq!(frame.structure.cell.0, [[0.0, 2.0, 2.0], [2.0, 0.0, 2.0], [2.0, 2.0, 0.0]]);
    assert_eq!(frame.structure.positions, [[0.0; 3], [1.0; 3]]);
    assert_eq!(frame.structure.periodic, [true; 3]);
    let flags = ColumnData::Bool(vec![true, true, false, false, true, true]);
    assert_eq!(frame.arrays["move_mask"], Column { width: 3, entries: flags });
    assert_eq!(frame.info["comment"].text(), Some("Gallium arsenide, it says"));
}

#[test]
fn scale_factors() {
    let cell = |scale: &str| {
        let text = format!("\n{scale}\n1 0 0\n0 2 0\n0 0 4\nAl\n1\nCartesian\n0.5 1 2\n");
        read(&text).map(|frame| (frame.structure.cell.0, frame.structure.positions[0]))
    };
    let doubled = [[2.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 8.0]];
    assert_eq!(cell("2").unwrap(), (doubled, [1.0, 2.0, 4.0]));
    let (volume, position) = cell("-64").unwrap();
    for k in 0..3 {
        assert!(norm(sub(volume[k], doubled[k])) < 1e-14);
    }
    assert!(norm(sub(position, [1.0, 2.0, 4.0])) < 1e-14);
    let (three, position) = cell("3 2 1").unwrap();
    assert_eq!((three[0][0], three[1][1], three[2][2], position), (3.0, 4.0, 4.0, [1.5, 2.0, 2.0]));
    for scale in ["0", "x", "1 2", "1 2 -3", "inf", ""] {
        let expected = "line 2: found '".to_owned()
            + scale
            + "', expected a scale factor (three positive ones, or a negative one: the volume)";
        assert_eq!(cell(scale).unwrap_err().to_string(), expected);
    }
}

#[test]
fn errors_tell_line_found_and_expected() {
    let head = "x\n1\n4 0 0\n0 4 0\n0 0 4\n";
    for (text, message) in [
        ("", "line 1: the file ends here, expected a comment"),
        ("x\n1\n1 2\n", "line 3: found '1 2', expected a lattice vector of three finite numbers"),
        (
            &format!("{head}1\nDirect\n0 0 0\n"),
            "line 6: found '1', expected element symbols: this is a file of VASP 4; insert a line such as 'Al Si' above it",
        ),
        (&format!("{head}\n1\n"), "line 6: found '', expected element symbols"),
        (
            &format!("{head}Al Xx\n1 1\n"),
            "line 6: unknown element 'Xx' (expected a symbol such as Al, or an atomic number from 1 to 118)",
        ),
        (
            &format!("{head}Al Si\n1\n"),
            "line 7: found '1', expected a number of atoms for each element symbol",
        ),
        (
            &format!("{head}Al\n-1\n"),
            "line 7: found '-1', expected a number of atoms for each element symbol",
        ),
        (&format!("{head}Al\n1\n0 0 0\n"), "line 8: found '0 0 0', expected 'Direct' or 'Cartesian'"),
        (
            &format!("{head}Al\n1\nSelective\n0 0 0\n"),
            "line 9: found '0 0 0', expected 'Direct' or 'Cartesian'",
        ),
        (
            &format!("{head}Al\n1000000000000000000\nDirect\n0 0 0\n"),
            "line 10: the file ends here, expected a position of three finite numbers",
        ),
        (
            &format!("{head}Al\n2\nDirect\n0 0 0\n0 0 nan\n"),
            "line 10: found '0 0 nan', expected a position of three finite numbers",
        ),
        (
            &format!("{head}Al\n1\nS\nD\n0 0 0 T T\n"),
            "line 10: found '0 0 0 T T', expected a position of three finite numbers and three of T and F",
        ),
        (&format!("{head}Al\n0\nDirect\n"), "line 8: the structure has no atoms"),
    ] {
        assert_eq!(read(text).unwrap_err().to_string(), message);
    }
}

#[test]
fn atoms_of_an_element_are_written_together() {
    let species = ["Si", "Al", "Si", "O"].map(|symbol| symbol.parse().unwrap()).to_vec();
    let positions = vec![[0.1, 0.2, 0.3], [1e-7, -5.0, 2.0], [0.7, 1.0 / 3.0, 9.0], [3.0, 3.0, 3.0]];
    let cell = Cell([[4.0, 0.1, 0.0], [0.0, 5.0, 0.0], [0.3, 0.0, 6.0]]);
    let mut structure = Structure { species, positions, cell, periodic: [true, true, false] };
    let mut text = Vec::new();
    assert_eq!(write_poscar(&mut text, &structure, "name\nmore").unwrap(), [0, 2, 1, 3]);
    let frame = read_poscar(text.as_slice()).unwrap();
    for (k, atom) in [0, 2, 1, 3].into_iter().enumerate() {
        assert_eq!(frame.structure.positions[k], structure.positions[atom]);
        assert_eq!(frame.structure.species[k], structure.species[atom]);
    }
    assert_eq!(frame.structure.cell, structure.cell);
    assert_eq!(frame.info["comment"].text(), Some("name"));
    structure.cell = Cell([[0.0; 3]; 3]);
    structure.periodic = [false; 3];
    assert!(matches!(write_poscar(&mut text, &structure, ""), Err(PoscarWriteError::Structure(_))));
}

proptest! {
    #[test]
    fn damaged_files_never_panic(cut in 0..250_usize, at in 0..250_usize, byte in any::<u8>()) {
        let mut bytes = SELECTIVE.as_bytes()[..cut.min(SELECTIVE.len())].to_vec();
        if let Some(place) = bytes.get_mut(at) {
            *place = byte;
        }
        if let Err(error) = read_poscar(bytes.as_slice()) {
            prop_assert!((1..=12).contains(&error.line));
        }
    }

    #[test]
    fn random_bytes_never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
        prop_assert!(read_poscar(bytes.as_slice()).is_err());
    }
}
