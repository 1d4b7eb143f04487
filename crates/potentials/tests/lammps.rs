//! EAM, Stillinger–Weber and ZBL against LAMMPS (see `data/lammps_reference.py`).

use std::path::{Path, PathBuf};

use atoms::units::COULOMB;
use atoms::{Cell, Matrix3, Potential, Structure, Vec3};
use potentials::{Eam, StillingerWeber, Zbl, ZblWindow, ZblWindows};
use serde_json::Value;

use crate::common;
use crate::common::assert_close;

const HERE: &str = env!("CARGO_MANIFEST_DIR");

struct Case {
    potential: String,
    name: String,
    structure: Structure,
    energy: f64,
    forces: Vec<Vec3>,
    virial: Matrix3,
}

fn vectors(value: &Value) -> Vec<Vec3> {
    let vector = |row: &Value| std::array::from_fn(|k| row[k].as_f64().unwrap());
    value.as_array().unwrap().iter().map(vector).collect()
}

fn case(value: &Value) -> Case {
    let text = |key: &str| value[key].as_str().unwrap().to_owned();
    let symbols = value["species"].as_array().unwrap();
    Case {
        potential: text("potential"),
        name: text("name"),
        structure: Structure {
            species: symbols.iter().map(|s| s.as_str().unwrap().parse().unwrap()).collect(),
            positions: vectors(&value["positions"]),
            cell: Cell(vectors(&value["cell"]).try_into().unwrap()),
            periodic: std::array::from_fn(|k| value["periodic"][k].as_bool().unwrap()),
        },
        energy: value["energy"].as_f64().unwrap(),
        forces: vectors(&value["forces"]),
        virial: vectors(&value["virial"]).try_into().unwrap(),
    }
}

/// The cases of the potential with this name.
fn cases(potential: &str) -> Vec<Case> {
    let text = std::fs::read_to_string(format!("{HERE}/tests/data/lammps_reference.json")).unwrap();
    let all: Value = serde_json::from_str(&text).unwrap();
    let cases: Vec<Case> = all["cases"].as_array().unwrap().iter().map(case).collect();
    let chosen: Vec<Case> = cases.into_iter().filter(|case| case.potential == potential).collect();
    assert!(!chosen.is_empty(), "{potential}");
    chosen
}

/// Energy to 1e-9 eV per atom, forces and virial to 1e-9 of the largest component (or 1e-12 eV/Å, eV).
fn compare(potential: &mut dyn Potential, name: &str, scale: f64) {
    let (mut energy_error, mut force_error, mut virial_error) = (0.0_f64, 0.0_f64, 0.0_f64);
    for case in cases(name) {
        let found = common::evaluate(potential, &case.structure);
        let what = format!("{name}, {}", case.name);
        let n = case.structure.len() as f64;
        let error = (found.energy() - scale * case.energy).abs() / n;
        energy_error = energy_error.max(error);
        assert!(error < 1e-9 * scale.max(1.0), "{what}: {} eV is not {}", found.energy(), case.energy);
        force_error = force_error.max(deviation(&what, &found.forces, &case.forces, scale));
        virial_error = virial_error.max(deviation(&what, &found.virial, &case.virial, scale));
    }
    eprintln!(
        "{name}: energy {energy_error:.1e} eV/atom, forces {force_error:.1e}, virial {virial_error:.1e}"
    );
}

/// Asserts and returns the largest deviation relative to the largest component.
fn deviation(what: &str, found: &[Vec3], expected: &[Vec3], scale: f64) -> f64 {
    let expected: Vec<f64> = expected.as_flattened().iter().map(|x| scale * x).collect();
    let found = found.as_flattened();
    let largest = expected.iter().fold(0.0_f64, |m, x| m.max(x.abs()));
    let error = found.iter().zip(&expected).fold(0.0_f64, |m, (f, e)| m.max((f - e).abs()));
    if largest < 1e-3 {
        // Nearly zero by symmetry or at the cutoff; only rounding errors could be compared.
        assert!(error < 1e-12, "{what}: {error}");
        return 0.0;
    }
    assert_close(what, found, &expected, 1e-9);
    error / largest
}

fn committed(name: &str) -> PathBuf {
    Path::new(HERE).join("../../configs/data").join(name)
}

fn made_up(name: &str) -> PathBuf {
    Path::new(HERE).join("tests/data").join(name)
}

/// Directory of potentials that are too large for the repository.
fn further(name: &str) -> Option<PathBuf> {
    let directory = std::env::var_os("CALMWALK_PEER_DATA");
    if directory.is_none() {
        eprintln!("CALMWALK_PEER_DATA is not set: {name} is not compared");
    }
    Some(Path::new(&directory?).join("potentials").join(name))
}

#[test]
fn finnis_sinclair_of_one_element() {
    let name = "Al_mm.eam.fs";
    compare(&mut Eam::load(committed(name)).unwrap(), name, 1.0);
}

#[test]
fn finnis_sinclair_of_two_elements_beyond_the_density_table() {
    let name = "two_elements.eam.fs";
    compare(&mut Eam::load(made_up(name)).unwrap(), name, 1.0);
}

#[test]
fn alloy_of_two_elements() {
    let name = "CuNi.eam.alloy";
    if let Some(path) = further(name) {
        compare(&mut Eam::load(path).unwrap(), name, 1.0);
    }
}

#[test]
fn alloy_of_one_element() {
    let name = "Al_zhou.eam.alloy";
    if let Some(path) = further(name) {
        compare(&mut Eam::load(path).unwrap(), name, 1.0);
    }
}

#[test]
fn stillinger_weber_silicon() {
    let name = "Si.sw";
    compare(&mut StillingerWeber::load(committed(name)).unwrap(), name, 1.0);
}

#[test]
fn stillinger_weber_mixture() {
    let name = "two_elements.sw";
    compare(&mut StillingerWeber::load(made_up(name)).unwrap(), name, 1.0);
}

/// LAMMPS uses e²/(4πε₀) = 14.399645 eV Å, rounded; it switches where the repulsion has vanished.
#[test]
fn zbl() {
    let species = ["Al", "Si"].map(|symbol| symbol.parse().unwrap());
    compare(
        &mut Zbl::new(&species, &ZblWindows::Uniform(ZblWindow { inner: 19.0, outer: 20.0 })).unwrap(),
        "zbl",
        COULOMB / 14.399645,
    );
}
