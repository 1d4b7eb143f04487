//! VASP's files, written and read: small ones of our own (`tests/data/vasp`). Real ones:
//! `src/vasp/real_output_tests.rs`.

mod end_to_end;
mod faults;
mod setup;

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use atoms::{Cell, Structure};
use dft::vasp::{Vasp, VaspSettings};
use dft::{CalculationResults, DftBackend, Exit, Failure};
use tempfile::TempDir;

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/vasp").join(name)
}

fn text(name: &str) -> String {
    std::fs::read_to_string(data(name)).unwrap()
}

/// The structure of `tests/data/vasp`, whose files list both atoms of Al before that of O.
fn alumina() -> Structure {
    let cell = Cell([[4.1, 0.0, 0.0], [0.4, 4.3, 0.0], [0.0, 0.3, 4.6]]);
    let fractional = [[0.05, 0.1, 0.2], [0.5, 0.55, 0.6], [0.45, 0.15, 0.75]];
    Structure {
        species: ["Al", "O", "Al"].map(|symbol| symbol.parse().unwrap()).to_vec(),
        positions: fractional.map(|position| cell.cartesian(position)).to_vec(),
        cell,
        periodic: [true; 3],
    }
}

/// The results in `tests/data/vasp`.
fn expected() -> CalculationResults {
    let kilobar = [[-120.5, 3.25, -7.125], [3.25, 80.0, 12.5], [-7.125, 12.5, -12345.678]];
    CalculationResults {
        energy: -24.30612345,
        energy_without_smearing: Some(-24.20612345),
        forces: vec![[0.12345678, -0.2, 0.03], [0.37654322, -0.05, -1.78], [-0.5, 0.25, 1.75]],
        stress: Some(kilobar.map(|row| row.map(|kilobar| -kilobar / 1602.176634))),
        magnetic_moments: Some(vec![0.5, 1.5, -0.25]),
        magnetisation: Some(1.7512345),
        electronic_steps: Some(3),
    }
}

#[track_caller]
fn assert_close(found: &CalculationResults, expected: &CalculationResults, tolerance: f64) {
    let numbers = |calculated: &CalculationResults| {
        let mut numbers = calculated.forces.concat();
        numbers.extend(calculated.stress.iter().flatten().flatten());
        numbers.extend(calculated.magnetic_moments.iter().flatten());
        numbers.extend([calculated.energy, calculated.energy_without_smearing.unwrap()]);
        numbers.extend(calculated.magnetisation);
        numbers
    };
    let (found_numbers, expected_numbers) = (numbers(found), numbers(expected));
    assert_eq!(found_numbers.len(), expected_numbers.len(), "{found:?}\n{expected:?}");
    let close = found_numbers.iter().zip(&expected_numbers).all(|(a, b)| (a - b).abs() <= tolerance);
    assert!(close, "{found:?}\n{expected:?}");
    assert_eq!(found.electronic_steps, expected.electronic_steps);
}

/// A file that looks like a POTCAR.
fn potcar(title: &str, element: &str, valence: f64) -> String {
    format!(
        "  {title}\n   {valence}\n parameters from PSCTR are:\n   VRHFIN ={element}: s2p1\n   LEXCH  = PE\n   \
         TITEL  = {title}\n   POMASS =   1.000; ZVAL   = {valence:8.3}    mass and valenz\n \
         END of PSCTR-controll parameters\n End of Dataset\n"
    )
}

/// Settings for these elements, with POTCAR files in `directory`.
fn settings(directory: &Path, version: &str, elements: &[&str]) -> VaspSettings {
    for element in elements {
        let potcar = potcar(&format!("PAW_PBE {element} 01Jan2000"), element, 3.0);
        std::fs::create_dir_all(directory.join(element)).unwrap();
        std::fs::write(directory.join(element).join("POTCAR"), potcar).unwrap();
    }
    VaspSettings {
        command: vec!["sh".to_owned()],
        version: version.to_owned(),
        pseudopotentials: directory.to_owned(),
        pseudopotential_variants: elements
            .iter()
            .map(|element| (element.parse().unwrap(), (*element).to_owned()))
            .collect(),
        ..VaspSettings::default()
    }
}

/// Reads these files as the calculation of [`alumina`].
fn read(files: &[(&str, &[u8])], exit: Exit) -> Result<CalculationResults, Failure> {
    let directory = TempDir::new().unwrap();
    for (name, content) in files {
        std::fs::write(directory.path().join(name), content).unwrap();
    }
    static VASP: LazyLock<Vasp> = LazyLock::new(|| {
        let directory = TempDir::new().unwrap();
        settings(directory.path(), "5.4.4", &["Al", "O"]).prepare().unwrap()
    });
    VASP.read(&alumina(), directory.path(), exit)
}
