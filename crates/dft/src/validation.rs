//! Checks that apply to every calculation, whichever program made it.

use std::path::Path;

use crate::result_file::{self, ResultFileError};
use crate::{CalculationResults, Exit, Failure, FailureClass};

/// The failure of a calculation without a complete result. `logs` are files in `directory` whose last lines go
/// into the message.
pub(crate) fn failure_without_result(exit: Exit, directory: &Path, logs: &[&str]) -> Failure {
    let ends =
        logs.iter().filter_map(|log| Some(format!("{log} ends with: {}", tail(&directory.join(log))?)));
    let messages = ends.collect::<Vec<_>>().join("; ");
    let Failure { class, message } = exit.failure();
    let (class, message) = match exit {
        // If we did not send the signal, the kernel did; shells and launchers return 128 + 9.
        Exit::Signal(9) | Exit::Code(137) => (
            FailureClass::OutOfMemory,
            "killed, probably by the kernel because memory was exhausted".to_owned(),
        ),
        Exit::Code(_) | Exit::Signal(_) if mentions_memory(&messages) => (FailureClass::OutOfMemory, message),
        Exit::Code(0) => (class, format!("{message}, but left no complete result")),
        _ => (class, message),
    };
    class.with_message(if messages.is_empty() { message } else { format!("{message}; {messages}") })
}

fn mentions_memory(log: &str) -> bool {
    let log = log.to_lowercase();
    [
        "out of memory",
        "cannot allocate memory",
        "bad_alloc",
        "memoryerror",
        "oom-kill",
        "insufficient virtual memory",
    ]
    .iter()
    .any(|words| log.contains(words))
}

/// The last lines of a file, joined to one; `None` if there are none.
fn tail(path: &Path) -> Option<String> {
    const BYTES: u64 = 4096;
    const LINES: usize = 6;
    const CHARACTERS: usize = 400;
    let end = result_file::tail(path, BYTES).ok()?;
    let end = String::from_utf8_lossy(&end.bytes);
    let mut lines: Vec<&str> =
        end.lines().rev().map(str::trim).filter(|line| !line.is_empty()).take(LINES).collect();
    lines.reverse();
    let joined = lines.join(" | ");
    let surplus = joined.chars().count().saturating_sub(CHARACTERS);
    let last: String = joined.chars().skip(surplus).collect();
    (!last.is_empty()).then_some(last)
}

/// Reads a file that a calculation left; `None` if it does not exist.
///
/// # Errors
/// [`FailureClass::Crashed`] if the file must not be read.
pub(crate) fn read_output_file(directory: &Path, name: &str) -> Result<Option<Vec<u8>>, Failure> {
    match result_file::read(&directory.join(name)) {
        Ok(content) => Ok(Some(content)),
        Err(ResultFileError::Missing) => Ok(None),
        Err(error) => Err(unreadable(name, &error)),
    }
}

/// The failure of a calculation that left such a file.
pub(crate) fn unreadable(name: &str, error: &ResultFileError) -> Failure {
    FailureClass::Crashed.with_message(format!("{name} {error}"))
}

/// Compares the version of a result with the expected one.
///
/// # Errors
/// [`FailureClass::OtherProgram`]
pub(crate) fn check_version(program: &str, found: &str, expected: &str) -> Result<(), Failure> {
    let another = || {
        let message = format!("calculated by {program} {found}, but the protocol requires {expected}");
        FailureClass::OtherProgram.with_message(message)
    };
    if found == expected { Ok(()) } else { Err(another()) }
}

/// Checks that the arrays match the number of atoms and all numbers are finite.
///
/// # Errors
/// [`FailureClass::Implausible`]
pub(crate) fn check_numbers(calculated: &CalculationResults, atoms: usize) -> Result<(), Failure> {
    let implausible = |message: String| Err(FailureClass::Implausible.with_message(message));
    let CalculationResults {
        energy,
        energy_without_smearing,
        forces,
        stress,
        magnetic_moments,
        magnetisation,
        ..
    } = calculated;
    if forces.len() != atoms {
        return implausible(format!("{} forces for {atoms} atoms", forces.len()));
    }
    if let Some(moments) = magnetic_moments.as_ref().filter(|moments| moments.len() != atoms) {
        return implausible(format!("{} magnetic moments for {atoms} atoms", moments.len()));
    }
    let scalars = [Some(*energy), *energy_without_smearing, *magnetisation];
    let named = [
        ("the energy", scalars.iter().flatten().all(|x| x.is_finite())),
        ("a force", forces.iter().flatten().all(|x| x.is_finite())),
        ("the stress", stress.iter().flatten().flatten().all(|x| x.is_finite())),
        ("a magnetic moment", magnetic_moments.iter().flatten().all(|x| x.is_finite())),
    ];
    match named.iter().find(|(_, finite)| !finite) {
        Some((name, _)) => implausible(format!("{name} is not a finite number")),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_are_none_are_implausible() {
        let good = CalculationResults { forces: vec![[0.0; 3]; 2], ..Default::default() };
        assert_eq!(check_numbers(&good, 2), Ok(()));
        assert!(check_numbers(&good, 3).is_err());
        let nan = |change: fn(&mut CalculationResults)| {
            let mut bad = good.clone();
            change(&mut bad);
            check_numbers(&bad, 2).unwrap_err().message
        };
        assert_eq!(nan(|c| c.energy = f64::NAN), "the energy is not a finite number");
        assert_eq!(nan(|c| c.forces[1][2] = f64::INFINITY), "a force is not a finite number");
        assert_eq!(nan(|c| c.stress = Some([[f64::NAN; 3]; 3])), "the stress is not a finite number");
        assert_eq!(nan(|c| c.magnetic_moments = Some(vec![0.0])), "1 magnetic moments for 2 atoms");
    }

    #[test]
    fn how_it_ended_says_why_there_is_no_result() {
        let directory = tempfile::tempdir().unwrap();
        let class = |exit| failure_without_result(exit, directory.path(), &["stdout", "stderr"]).class;
        assert_eq!(class(Exit::TimeLimit), FailureClass::TimeLimit);
        assert_eq!(class(Exit::LostNode), FailureClass::NodeFailure);
        assert_eq!(class(Exit::Signal(9)), FailureClass::OutOfMemory);
        assert_eq!(class(Exit::Signal(11)), FailureClass::Crashed);
        assert_eq!(class(Exit::Code(0)), FailureClass::Crashed);

        std::fs::write(directory.path().join("stderr"), "first\n\n what(): std::bad_alloc\n").unwrap();
        let failure = failure_without_result(Exit::Signal(6), directory.path(), &["stdout", "stderr"]);
        assert_eq!(failure.class, FailureClass::OutOfMemory);
        assert!(failure.message.ends_with("stderr ends with: first | what(): std::bad_alloc"), "{failure}");
    }
}
