//! Runs calculations like a labeller, in this process.

use std::collections::BTreeSet;
use std::fs::File;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Command, Stdio};

use atoms::Structure;
use dft::{
    CalculationInput, CalculationResults, DftBackend, Exit, Failure, FailureClass, RetryAdjustment,
    adjustments,
};

/// One calculation from its input to its result.
pub fn attempt(
    code: &dyn DftBackend,
    structure: &Structure,
    adjustments: &BTreeSet<RetryAdjustment>,
) -> Result<CalculationResults, Failure> {
    let place = tempfile::tempdir().unwrap();
    let input = prepared(code, structure, adjustments, place.path())?;
    calculate(code, structure, input, place.path())
}

/// Writes the input to folders of this directory.
pub fn prepared(
    code: &dyn DftBackend,
    structure: &Structure,
    adjustments: &BTreeSet<RetryAdjustment>,
    place: &Path,
) -> Result<CalculationInput, Failure> {
    let input = code.input(structure, adjustments)?;
    let [work, data] = ["work", "data"].map(|folder| place.join(folder));
    [&work, &data].into_iter().for_each(|folder| std::fs::create_dir(folder).unwrap());
    for (name, content) in &input.files {
        std::fs::write(work.join(name), content).unwrap();
    }
    for (name, original) in &input.data {
        std::fs::write(data.join(name), original.content().unwrap()).unwrap();
    }
    Ok(input)
}

/// Runs a prepared calculation and reads its result.
pub fn calculate(
    code: &dyn DftBackend,
    structure: &Structure,
    input: CalculationInput,
    place: &Path,
) -> Result<CalculationResults, Failure> {
    let directory = place.join("work");
    let output = |name| Stdio::from(File::create(directory.join(name)).unwrap());
    let status = Command::new(&input.command[0])
        .args(&input.command[1..])
        .envs(&input.environment)
        .current_dir(&directory)
        .stdin(Stdio::null())
        .stdout(output("stdout"))
        .stderr(output("stderr"))
        .status()
        .unwrap_or_else(|error| panic!("{:?} does not start: {error}", input.command));
    let exit = status.code().map(Exit::Code).or(status.signal().map(Exit::Signal)).unwrap();
    if let Some(kept) = std::env::var_os("CALMWALK_KEEP") {
        let name = format!("{:?}-{}", std::thread::current().id(), structure.formula());
        Command::new("cp").arg("-r").arg(place).arg(Path::new(&kept).join(name)).status().unwrap();
    }
    code.read(structure, &directory, exit)
}

/// A calculation that must succeed.
pub fn label(code: &dyn DftBackend, structure: &Structure) -> CalculationResults {
    attempt(code, structure, &BTreeSet::new())
        .unwrap_or_else(|failure| panic!("{}: {failure}", structure.formula()))
}

/// Retries with the adjustments until the calculation succeeds; returns the number of failures.
pub fn climb(code: &dyn DftBackend, structure: &Structure) -> (CalculationResults, Vec<FailureClass>) {
    let mut failures = Vec::new();
    loop {
        let changes = adjustments(&failures).unwrap_or_else(|| panic!("given up after {failures:?}"));
        match attempt(code, structure, &changes) {
            Ok(calculated) => return (calculated, failures),
            Err(failure) => failures.push(failure.class),
        }
    }
}
