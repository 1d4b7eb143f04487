//! A stand-in for VASP that handles its files but returns precomputed results.

use std::collections::BTreeSet;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

use atoms::{Cell, Structure, read_poscar};
use dft::{CalculationInput, DftBackend, Exit, FailureClass, RetryAdjustment};
use tempfile::TempDir;

use super::{alumina, assert_close, data, expected, settings, text};

fn input(structure: &Structure, adjustments: &[RetryAdjustment]) -> CalculationInput {
    let directory = TempDir::new().unwrap();
    let mut settings = settings(directory.path(), "5.4.4", &["Al", "O"]);
    settings.initial_magnetic_moments = [("O".parse().unwrap(), 0.25)].into();
    let code = settings.prepare().unwrap();
    code.input(structure, &BTreeSet::from_iter(adjustments.iter().copied())).unwrap()
}

fn file(input: &CalculationInput, name: &str) -> String {
    String::from_utf8(input.files[name].clone()).unwrap()
}

#[test]
fn from_the_structure_to_its_label() {
    let (home, place) = (TempDir::new().unwrap(), TempDir::new().unwrap());
    let program = home.path().join("vasp_std");
    let script = format!(
        "#!/bin/sh\nset -e\ngrep -q 'ENCUT = 500.0' INCAR\ntest -s POSCAR -a -s POTCAR -a -s KPOINTS\n\
         test \"$OMP_NUM_THREADS\" = 1\ncp '{}' '{}' .\n",
        data("vasprun.xml").display(),
        data("OUTCAR").display()
    );
    std::fs::write(&program, script).unwrap();
    std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
    let mut settings = settings(home.path(), "5.4.4", &["Al", "O"]);
    settings.command = vec![program.to_str().unwrap().to_owned()];
    let code = settings.prepare().unwrap();
    let input = code.input(&alumina(), &BTreeSet::new()).unwrap();
    for (name, content) in &input.files {
        std::fs::write(place.path().join(name), content).unwrap();
    }
    let status =
        Command::new(&input.command[0]).envs(&input.environment).current_dir(place.path()).status().unwrap();
    let calculated = code.read(&alumina(), place.path(), Exit::Code(status.code().unwrap())).unwrap();
    assert_close(&calculated, &expected(), 1e-12);
}

#[test]
fn all_files_have_the_same_order_of_atoms() {
    let input = input(&alumina(), &[]);
    let poscar = read_poscar_text(&file(&input, "POSCAR"));
    let order = [0, 2, 1];
    assert_eq!(poscar.species, order.map(|atom| alumina().species[atom]));
    assert_eq!(poscar.positions, order.map(|atom| alumina().positions[atom]));
    let titles: Vec<String> =
        file(&input, "POTCAR").lines().filter(|line| line.contains("TITEL")).map(str::to_owned).collect();
    assert_eq!(titles, ["   TITEL  = PAW_PBE Al 01Jan2000", "   TITEL  = PAW_PBE O 01Jan2000"]);
    assert!(file(&input, "INCAR").contains("\nMAGMOM = 2*1.0 1*0.25\n"));
}

fn read_poscar_text(text: &str) -> Structure {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), text).unwrap();
    read_poscar(file.path()).unwrap().structure
}

#[test]
fn the_mesh_is_that_of_the_spacing_with_two_pi() {
    let aluminium = Structure {
        species: vec!["Al".parse().unwrap()],
        positions: vec![[0.0; 3]],
        cell: Cell::orthorhombic(4.05, 4.05, 8.1),
        periodic: [true; 3],
    };
    // 2π / 4.05 / 0.125 = 12.41, 2π / 8.1 / 0.125 = 6.21; VASP's KSPACING gives the same.
    let kpoints = file(&input(&aluminium, &[]), "KPOINTS");
    assert_eq!(kpoints.lines().skip(1).collect::<Vec<_>>(), ["0", "Gamma", "13 13 7", "0 0 0"]);
    let slab = Structure { periodic: [true, true, false], ..aluminium };
    assert_eq!(file(&input(&slab, &[]), "KPOINTS").lines().nth(3), Some("13 13 1"));
}

#[test]
fn a_left_handed_cell_is_turned_and_its_numbers_are_the_same() {
    // Rotated, it is the cell of the files.
    let mut left = alumina();
    left.cell.0.swap(1, 2);
    assert!(left.cell.signed_volume() < 0.0);
    assert!(read_poscar_text(&file(&input(&left, &[]), "POSCAR")).cell.signed_volume() > 0.0);
    let (home, place) = (TempDir::new().unwrap(), TempDir::new().unwrap());
    std::fs::write(place.path().join("vasprun.xml"), text("vasprun.xml")).unwrap();
    let code = settings(home.path(), "5.4.4", &["Al", "O"]).prepare().unwrap();
    let calculated = code.read(&left, place.path(), Exit::Code(0)).unwrap();
    assert_eq!((calculated.forces, calculated.stress), (expected().forces, calculated.stress));
}

#[test]
fn adjustments_leave_all_files_but_incar_alone() {
    let (plain, mut adjusted) = (input(&alumina(), &[]), input(&alumina(), &RetryAdjustment::ALL));
    let incar = file(&adjusted, "INCAR");
    assert!(incar.contains("\nMAGMOM = 2*0.5 1*0.125\n"), "{incar}");
    assert!(incar.contains("\nNELM = 300\nALGO = All\n"), "{incar}");
    assert_ne!(adjusted.files["INCAR"], plain.files["INCAR"]);
    adjusted.files.insert("INCAR".to_owned(), plain.files["INCAR"].clone());
    assert_eq!(adjusted, plain);
}

#[test]
fn an_element_without_a_potential_is_bad_input() {
    let home = TempDir::new().unwrap();
    let code = settings(home.path(), "5.4.4", &["Al"]).prepare().unwrap();
    let failure = code.input(&alumina(), &BTreeSet::new()).unwrap_err();
    assert_eq!(failure.class, FailureClass::BadInput);
    assert!(failure.message.contains("of O: none is selected"), "{failure}");
    assert!(Path::new(&settings(home.path(), "5.4.4", &["Al"]).pseudopotentials).exists());
}
