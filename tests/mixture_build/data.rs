//! Dumps of LAMMPS and filters.

use std::fmt::Write as _;

use super::*;

/// A dump with bitwise equal numbers and another order of atoms.
fn dump(frames: &[Frame], element: bool) -> String {
    let mut text = String::new();
    for (number, Frame { structure, .. }) in frames.iter().enumerate() {
        let periodic = structure.periodic.map(|periodic| if periodic { "pp" } else { "ff" }).join(" ");
        writeln!(text, "ITEM: TIMESTEP\n{number}\nITEM: NUMBER OF ATOMS\n{}", structure.len()).unwrap();
        writeln!(text, "ITEM: BOX BOUNDS abc origin {periodic}").unwrap();
        for [x, y, z] in structure.cell.0 {
            writeln!(text, "{x:?} {y:?} {z:?} 0").unwrap();
        }
        writeln!(text, "ITEM: ATOMS id x y z {}", if element { "element" } else { "type" }).unwrap();
        for (atom, [x, y, z]) in structure.positions.iter().enumerate().rev() {
            let species = if element { structure.species[atom].symbol() } else { "2" };
            writeln!(text, "{atom} {x:?} {y:?} {z:?} {species}").unwrap();
        }
    }
    text
}

#[test]
fn dumps_of_lammps_are_the_same_structures() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let frames = frames();
    write_frames(&here.join("data.extxyz"), &frames);
    fs::write(here.join("first.lammpstrj"), dump(&frames[..20], true)).unwrap();
    let packed = zstd::encode_all(dump(&frames[20..], false).as_bytes(), 3).unwrap();
    fs::write(here.join("second.dump.zst"), packed).unwrap();
    let (expected, _) = build(here, "expected.npz", &["data.extxyz"], &[]);
    let files = ["first.lammpstrj", "second.dump.zst"];
    let (found, _) = build(here, "out.npz", &files, &["--dump-elements", "Si,Al"]);
    assert!(found == expected);

    let message = refuse(here, arguments("x.npz", &files, &[]));
    assert!(message.contains("second.dump.zst:9: the dump has no column 'element'"), "{message}");
    assert!(message.contains("--dump-elements Al,Mo"), "{message}");
    let message = refuse(here, arguments("x.npz", &files, &["--restart", "--dump-elements", "Al"]));
    assert!(message.contains("found atom type 2, but elements are given for types 1 to 1"), "{message}");
}

#[test]
fn a_filter_leaves_structures_out() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let frames = frames();
    write_frames(&here.join("data.extxyz"), &frames);
    let energy = |frame: &Frame| frame.labels().unwrap().energy.unwrap();
    let mut energies: Vec<f64> = frames.iter().map(energy).collect();
    energies.sort_by(f64::total_cmp);
    let kept: Vec<Frame> = frames.iter().filter(|frame| energy(frame) < energies[30]).cloned().collect();
    assert_eq!(kept.len(), 30);
    write_frames(&here.join("kept.extxyz"), &kept);
    let (expected, _) = build(here, "expected.npz", &["kept.extxyz"], &[]);
    let condition = format!("energy < {:?} and element = Al and atoms = 108", energies[30]);
    let all = arguments("out.npz", &["data.extxyz"], &["--where", &condition]);
    let output = calmwalk(here, &all);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert!(
        stderr(&output).contains("30 structures in 10 shards, 20 left out by --where"),
        "{}",
        stderr(&output)
    );
    assert!(fs::read(here.join("out.npz")).unwrap() == expected);

    for (condition, reason) in [
        ("atoms > 108", "no structure of the files matches --where 'atoms > 108.0'"),
        ("gamma > 1", "--where: structures of files have no 'gamma'; expected one of atoms, element"),
        ("atoms >", "expected a number"),
    ] {
        let message = refuse(here, arguments("x.npz", &["data.extxyz"], &["--where", condition]));
        assert!(message.contains(reason), "{message}");
        assert!(!here.join("x.npz").exists());
    }
}
