//! A calculation reads the data that was hashed, even if the original files change afterwards.

use std::collections::BTreeSet;
use std::path::Path;

use dft::{DftBackend, PassedEnvironment, abinit, cp2k, espresso, gpaw};
use tempfile::TempDir;

use crate::run::{calculate, label, prepared};
use crate::structures;

/// Copies of files from a directory.
fn copies(from: &str, names: &[&str]) -> TempDir {
    let directory = TempDir::new().unwrap();
    for name in names {
        std::fs::copy(Path::new(from).join(name), directory.path().join(name)).unwrap();
    }
    directory
}

/// Compares a label of silicon whose data files are deleted before the program starts with one whose files
/// remain.
fn needs_no_files(code: &dyn DftBackend, data: TempDir) {
    let (structure, place) = (structures::silicon(), TempDir::new().unwrap());
    let expected = label(code, &structure);
    let input = prepared(code, &structure, &BTreeSet::new(), place.path()).unwrap();
    data.close().unwrap();
    let found = calculate(code, &structure, input, place.path()).unwrap();
    assert!((found.energy - expected.energy).abs() < 1e-6, "{found:?} {expected:?}");
}

#[test]
fn abinit_reads_copies() {
    let psp8 = copies("/usr/share/abinit/psp/Pseudodojo_nc_sr_04_pbe_standard_psp8", &["Si.psp8"]);
    let xml = copies("/usr/share/abinit/psp/Pseudodojo_paw_pbe_standard", &["Si.xml"]);
    for data in [psp8, xml] {
        let pseudopotentials = data.path().to_owned();
        let settings = abinit::AbinitSettings {
            pseudopotentials,
            cutoff: 200.0,
            k_spacing: 1.2,
            spin_polarized: false,
            ..Default::default()
        };
        needs_no_files(&settings.prepare(&PassedEnvironment::default()).unwrap(), data);
    }
}

#[test]
fn espresso_reads_copies() {
    let norm_conserving = copies("/usr/share/espresso/pseudo", &["Si.pbe-rrkj.UPF"]);
    let ultrasoft = copies("/usr/share/espresso/pseudo", &["Si.pbe-nl-rrkjus_psl.1.0.0.UPF"]);
    for data in [norm_conserving, ultrasoft] {
        let settings = espresso::EspressoSettings {
            pseudopotentials: data.path().to_owned(),
            cutoff: 200.0,
            k_spacing: 1.2,
            spin_polarized: false,
            ..Default::default()
        };
        needs_no_files(&settings.prepare(&PassedEnvironment::default()).unwrap(), data);
    }
}

#[test]
fn gpaw_reads_copies() {
    let data = copies("/usr/share/gpaw-setups", &["Si.PBE.gz"]);
    let pseudopotentials = Some(data.path().to_owned());
    let settings = gpaw::GpawSettings {
        pseudopotentials,
        cutoff: 200.0,
        k_spacing: 1.2,
        spin_polarized: false,
        ..Default::default()
    };
    needs_no_files(&settings.prepare(&PassedEnvironment::default()).unwrap(), data);
}

#[test]
fn cp2k_reads_copies() {
    let data = copies("/usr/share/cp2k", &["BASIS_MOLOPT", "GTH_POTENTIALS"]);
    let settings = cp2k::Cp2kSettings {
        pseudopotentials: data.path().to_owned(),
        basis: "SZV-MOLOPT-SR-GTH".into(),
        cutoff: 2000.0,
        relative_cutoff: 400.0,
        density_tolerance: 1e-6,
        k_spacing: 10.0,
        spin_polarized: false,
        ..Default::default()
    };
    needs_no_files(&settings.prepare(&PassedEnvironment::default()).unwrap(), data);
}
