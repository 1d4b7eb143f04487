//! Tests on files of real calculations, which we do not own and read in place (`CALMWALK_PEER_DATA`).

use std::path::{Path, PathBuf};
use std::process::Command;

use atoms::{Cell, Matrix3, Species, Structure, Vec3};
use tempfile::TempDir;

use super::result;
use crate::{CalculationResults, Exit, Failure, FailureClass};

/// The folder of the files; prints a note and returns `None` if it is unavailable.
fn peer(name: &str) -> Option<PathBuf> {
    let Some(root) = std::env::var_os("CALMWALK_PEER_DATA") else {
        eprintln!("CALMWALK_PEER_DATA is not set: {name} is not tested");
        return None;
    };
    Some(Path::new(&root).join("vasp").join(name))
}

/// The initial structure of a file, extracted without the parser.
fn initial(xml: &str) -> Structure {
    let part = |from: &str, to: &str| {
        let begin = xml.find(from).unwrap() + from.len();
        &xml[begin..begin + xml[begin..].find(to).unwrap()]
    };
    let vectors = |text: &str| -> Vec<Vec3> {
        let words =
            |line: &str| line.split_whitespace().filter_map(|word| word.parse().ok()).collect::<Vec<f64>>();
        text.lines().map(words).filter_map(|words| words.try_into().ok()).collect()
    };
    let initial = part("<structure name=\"initialpos\" >", "</structure>");
    let (cell, positions) = initial.split_once("<varray name=\"positions\" >").unwrap();
    let cell = Cell(Matrix3::try_from(vectors(cell)[..3].to_vec()).unwrap());
    let species: Vec<Species> = part("<array name=\"atoms\" >", "</array>")
        .split("<rc><c>")
        .skip(1)
        .map(|row| row.split('<').next().unwrap().trim().parse().unwrap())
        .collect();
    // Velocities may follow.
    let positions = vectors(positions).into_iter().take(species.len());
    let positions = positions.map(|fractional| cell.cartesian(fractional)).collect();
    Structure { species, positions, cell, periodic: [true; 3] }
}

/// Reads files as a calculation of `structure`, in its own order of atoms.
fn judge(
    structure: &Structure,
    version: &str,
    directory: &TempDir,
    exit: Exit,
) -> Result<CalculationResults, Failure> {
    let order: Vec<usize> = (0..structure.len()).collect();
    result::read(structure, &order, version, directory.path(), exit)
}

/// Reads one file as the calculation of its own initial structure.
fn judge_text(xml: &str, version: &str) -> Result<CalculationResults, Failure> {
    let directory = TempDir::new().unwrap();
    std::fs::write(directory.path().join("vasprun.xml"), xml).unwrap();
    judge(&initial(xml), version, &directory, Exit::Code(0))
}

/// The numbers to compare.
fn numbers(calculated: &CalculationResults) -> Vec<f64> {
    let energies = [calculated.energy, calculated.energy_without_smearing.unwrap()];
    [energies.as_slice(), &calculated.stress.unwrap().concat(), &calculated.forces.concat()].concat()
}

#[track_caller]
fn assert_close(found: &[f64], expected: &[f64], tolerance: f64) {
    assert!(found.len() >= expected.len());
    let close = found.iter().zip(expected).all(|(a, b)| (a - b).abs() <= tolerance * (1.0 + b.abs()));
    assert!(close, "{found:?}\n{expected:?}");
}

/// Converged calculations with ASE's values: energies (free, σ → 0), stress, the first force; eV, Å.
const CONVERGED: [(&str, &str, [f64; 14]); 3] = [
    (
        "converged_si_static",
        "5.2.12",
        [
            -10.64527774,
            -10.64527774,
            0.009503402,
            0.0,
            0.0,
            0.0,
            0.009503402,
            0.0,
            0.0,
            0.0,
            0.009503402,
            0.0,
            0.0,
            0.0,
        ],
    ),
    (
        "converged_fe_spin",
        "5.4.1",
        [
            711.33751372,
            711.33751372,
            7.71019128,
            0.0,
            0.0,
            0.0,
            7.71019128,
            0.0,
            0.0,
            0.0,
            -38.83052734,
            0.0,
            0.0,
            0.0,
        ],
    ),
    (
        "converged_ti_o_v6",
        "6.3.0",
        [
            -57.48343729,
            -57.47495449,
            0.124206117,
            1.94899861e-6,
            9.42461636e-7,
            1.94899861e-6,
            0.113505149,
            -2.02678029e-6,
            9.42461636e-7,
            -2.02678029e-6,
            0.233552123,
            1.34446109,
            -0.20195361,
            4.36e-5,
        ],
    ),
];

#[test]
fn converged_calculations_give_the_numbers_of_ase() {
    for (name, version, ase) in CONVERGED {
        let Some(folder) = peer(name) else { return };
        let directory = TempDir::new().unwrap();
        let xml = std::fs::read_to_string(folder.join("vasprun.xml")).unwrap();
        let structure = initial(&xml);
        std::fs::write(directory.path().join("vasprun.xml"), &xml).unwrap();
        std::fs::copy(folder.join("OUTCAR"), directory.path().join("OUTCAR")).unwrap();
        let calculated = judge(&structure, version, &directory, Exit::Code(0)).unwrap();
        assert_close(&numbers(&calculated), &ase, 1e-8);
        assert_eq!(calculated.magnetic_moments.is_some(), name != "converged_ti_o_v6", "{name}");

        // OUTCAR agrees up to its digits: six decimals of forces and, in old versions, of energies.
        std::fs::write(directory.path().join("vasprun.xml"), &xml[..xml.len() - 40]).unwrap();
        let from_outcar = judge(&structure, version, &directory, Exit::Code(0)).unwrap();
        assert_close(&numbers(&from_outcar), &numbers(&calculated), 6e-7);
        assert_eq!(from_outcar.electronic_steps, calculated.electronic_steps);
        assert_eq!(from_outcar.magnetic_moments, calculated.magnetic_moments);
    }
}

#[test]
fn magnetic_moments_are_those_of_outcar() {
    let Some(folder) = peer("converged_si_static") else { return };
    let xml = std::fs::read_to_string(folder.join("vasprun.xml")).unwrap();
    let directory = TempDir::new().unwrap();
    for name in ["vasprun.xml", "OUTCAR"] {
        std::fs::copy(folder.join(name), directory.path().join(name)).unwrap();
    }
    let calculated = judge(&initial(&xml), "5.2.12", &directory, Exit::Code(0)).unwrap();
    assert_eq!(calculated.magnetic_moments, Some(vec![0.0; 2]));
    assert_eq!(calculated.magnetisation, Some(-0.0002256));
    assert_eq!(calculated.electronic_steps, Some(13));
}

#[test]
fn a_calculation_without_stress_is_read_without() {
    let Some(folder) = peer("novirial_md") else { return };
    let xml = std::fs::read_to_string(folder.join("vasprun.xml")).unwrap();
    let failure = judge_text(&xml, "5.4.4").unwrap_err();
    let expected = (FailureClass::Implausible, "found 3 ionic steps, expected one");
    assert_eq!((failure.class, failure.message.as_str()), expected);
    // The first step alone, like a static calculation.
    let end = xml.find("</calculation>").unwrap() + "</calculation>".len();
    let calculated = judge_text(&format!("{}\n</modeling>\n", &xml[..end]), "5.4.4").unwrap();
    assert_eq!(calculated.stress, None);
    assert_eq!((calculated.energy, calculated.forces.len()), (-28.38622624, 6));
}

#[test]
fn files_that_are_cut_off_are_no_label() {
    let silicon = Structure {
        species: vec!["Si".parse().unwrap()],
        positions: vec![[0.0; 3]],
        cell: Cell::orthorhombic(4.0, 4.0, 4.0),
        periodic: [true; 3],
    };
    for (name, version) in
        [("vasprun.mid_calculation.xml", "5.2.2"), ("vasprun.before_first_step.xml", "5.3.5")]
    {
        let Some(folder) = peer("truncated") else { return };
        let directory = TempDir::new().unwrap();
        std::fs::copy(folder.join(name), directory.path().join("vasprun.xml")).unwrap();
        let class = |exit| judge(&silicon, version, &directory, exit).unwrap_err().class;
        assert_eq!(class(Exit::Code(0)), FailureClass::Crashed);
        assert_eq!(class(Exit::TimeLimit), FailureClass::TimeLimit);
    }
}

#[test]
fn a_calculation_that_did_not_converge_is_no_label_although_its_file_is_whole() {
    let Some(folder) = peer("unconverged_scf") else { return };
    let output = Command::new("gzip").arg("-dc").arg(folder.join("vasprun.xml.gz")).output().unwrap();
    assert!(output.status.success());
    let failure = judge_text(&String::from_utf8(output.stdout).unwrap(), "5.2.11").unwrap_err();
    assert_eq!(failure.class, FailureClass::NotConverged);
    assert_eq!(failure.message, "the electrons did not converge in 100 steps");
}
