//! Runs calculations as a labeller does, but here.

use std::collections::BTreeSet;
use std::fs::File;
use std::os::unix::process::ExitStatusExt;
use std::process::{Command, Stdio};

use atoms::Structure;
use dft::{Calculated, Code, Exit, Failure, FailureClass, Remedy, remedies};

/// One calculation from its input to its judgement.
pub fn attempt(
    code: &dyn Code,
    structure: &Structure,
    remedies: &BTreeSet<Remedy>,
) -> Result<Calculated, Failure> {
    let directory = tempfile::tempdir().unwrap();
    let input = code.input(structure, remedies)?;
    for (name, content) in &input.files {
        std::fs::write(directory.path().join(name), content).unwrap();
    }
    let output = |name| Stdio::from(File::create(directory.path().join(name)).unwrap());
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
        Command::new("cp")
            .arg("-r")
            .arg(directory.path())
            .arg(std::path::Path::new(&kept).join(name))
            .status()
            .unwrap();
    }
    code.read(structure, directory.path(), exit)
}

/// A calculation that must succeed.
pub fn label(code: &dyn Code, structure: &Structure) -> Calculated {
    attempt(code, structure, &BTreeSet::new())
        .unwrap_or_else(|failure| panic!("{}: {failure}", structure.formula()))
}

/// Tries until the calculation is a label, as the ladders say; how often it failed before.
pub fn climb(code: &dyn Code, structure: &Structure) -> (Calculated, Vec<FailureClass>) {
    let mut failures = Vec::new();
    loop {
        let changes = remedies(&failures).unwrap_or_else(|| panic!("given up after {failures:?}"));
        match attempt(code, structure, &changes) {
            Ok(calculated) => return (calculated, failures),
            Err(failure) => failures.push(failure.class),
        }
    }
}
