//! Reads what a calculation left.

use std::path::Path;

use atoms::Structure;

use super::outcar::Outcar;
use super::output::Output;
use super::vasprun;
use crate::structure_check::check_same_structure;
use crate::{CalculationResults, Exit, Failure, FailureClass, result_file, validation};

/// Reads the calculation of `structure` by this version of VASP. `order` gives the order of the atoms in the
/// files.
pub(super) fn read(
    structure: &Structure,
    order: &[usize],
    version: &str,
    directory: &Path,
    exit: Exit,
) -> Result<CalculationResults, Failure> {
    let outcar = match result_file::open_delimited(&directory.join("OUTCAR"), b'\n') {
        Ok(file) => Outcar::read(file),
        Err(error) if error.is_missing() => Outcar::default(),
        Err(error) => return Err(validation::unreadable("OUTCAR", &error)),
    };
    let magnetism = (outcar.moments.clone(), outcar.magnetisation);
    let denied = outcar.denies_convergence();
    let xml =
        result_file::open_delimited(&directory.join("vasprun.xml"), b'<').map_err(|error| error.to_string());
    let output = match xml.and_then(vasprun::read) {
        Ok(output) => output,
        Err(xml) => outcar.output().map_err(|outcar| without_output(exit, directory, &xml, &outcar))?,
    };
    let in_file_order = Structure {
        species: order.iter().map(|atom| structure.species[*atom]).collect(),
        positions: order.iter().map(|atom| structure.positions[*atom]).collect(),
        ..*structure
    };
    check(&output, &in_file_order, version)?;
    if denied {
        return Err(FailureClass::NotConverged.with_message("OUTCAR does not report that EDIFF was reached"));
    }
    let calculated = CalculationResults {
        energy: output.energy,
        energy_without_smearing: Some(output.energy_without_smearing),
        forces: restore_order(&output.forces, order),
        stress: output.stress,
        magnetic_moments: Some(magnetism.0)
            .filter(|m| m.len() == order.len())
            .map(|m| restore_order(&m, order)),
        magnetisation: magnetism.1,
        electronic_steps: Some(output.steps),
    };
    validation::check_numbers(&calculated, structure.len())?;
    Ok(calculated)
}

/// Checks that it is the requested calculation and that it converged.
fn check(output: &Output, asked: &Structure, version: &str) -> Result<(), Failure> {
    if !is_version(&output.version, version) {
        let found = &output.version;
        let message = format!("calculated by VASP {found}, but `version` is {version}: correct one of them");
        return Err(FailureClass::OtherProgram.with_message(message));
    }
    if output.steps >= output.most_steps {
        let message = format!("the electrons did not converge in {} steps", output.steps);
        return Err(FailureClass::NotConverged.with_message(message));
    }
    if output.ionic_steps != 1 {
        let message = format!("found {} ionic steps, expected one", output.ionic_steps);
        return Err(FailureClass::Implausible.with_message(message));
    }
    if output.forces.len() != asked.len() {
        let message = format!("found {} forces, expected {}", output.forces.len(), asked.len());
        return Err(FailureClass::Implausible.with_message(message));
    }
    check_same_structure(asked, &output.structure, output.resolution)
}

/// Whether a version such as `5.4.4.18Apr17` is 5.4.4; 5.4.40 is not.
fn is_version(found: &str, expected: &str) -> bool {
    found.strip_prefix(expected).is_some_and(|rest| !rest.starts_with(|c: char| c.is_alphanumeric()))
}

/// Reorders values from the files' order to the structure's; `order` is a permutation.
fn restore_order<T: Copy + Default>(values: &[T], order: &[usize]) -> Vec<T> {
    let mut sorted = vec![T::default(); values.len()];
    for (value, atom) in values.iter().zip(order) {
        sorted[*atom] = *value;
    }
    sorted
}

/// VASP's last messages before it stops, and their class. Where the minimisation broke down, another algorithm
/// may succeed.
const ERROR_MESSAGES: [(&str, FailureClass); 9] = [
    ("BRMIX: very serious problems", FailureClass::NotConverged),
    ("EDDDAV: Call to ZHEGV failed", FailureClass::NotConverged),
    ("Error EDDDAV", FailureClass::NotConverged),
    ("Error EDDRMM", FailureClass::NotConverged),
    ("ZPOTRF", FailureClass::NotConverged),
    ("FEXCF: supplied", FailureClass::BadInput),
    ("FEXCP: supplied", FailureClass::BadInput),
    ("internal error in subroutine SGRCON", FailureClass::BadInput),
    ("NELECT < 0", FailureClass::BadInput),
];

/// The failure of a calculation without complete output.
fn without_output(exit: Exit, directory: &Path, xml: &str, outcar: &str) -> Failure {
    let from_outside = matches!(exit, Exit::TimeLimit | Exit::OutOfMemory | Exit::LostNode);
    let said = if from_outside { String::new() } else { end_of(&directory.join("stdout")) };
    if let Some((words, class)) = ERROR_MESSAGES.iter().find(|(words, _)| said.contains(words)) {
        return class.with_message(format!("VASP stopped: {words}"));
    }
    let failure = validation::failure_without_result(exit, directory, &["stdout", "stderr"]);
    failure.class.with_message(format!("{}; vasprun.xml {xml}; OUTCAR {outcar}", failure.message))
}

/// The end of a file; empty if it does not exist.
fn end_of(path: &Path) -> String {
    const BYTES: u64 = 65_536;
    let end = result_file::tail(path, BYTES).map_or_else(|_| Vec::new(), |end| end.bytes);
    String::from_utf8_lossy(&end).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_are_compared_by_whole_numbers() {
        assert!(is_version("5.4.4.18Apr17-6-g9f103f2a35", "5.4.4"));
        assert!(is_version("6.3.0", "6.3"));
        for (found, expected) in [("5.4.40", "5.4.4"), ("6.3.0", "6.3.1"), ("", "6.3.0"), ("5.4.4b", "5.4.4")]
        {
            assert!(!is_version(found, expected), "{found} {expected}");
        }
    }

    #[test]
    fn values_go_back_to_their_atoms() {
        assert_eq!(restore_order(&['a', 'c', 'b'], &[0, 2, 1]), ['a', 'b', 'c']);
        assert_eq!(restore_order(&[10, 12, 11, 13], &[2, 0, 3, 1]), [12, 13, 10, 11]);
    }
}
