//! A user's program that reads a structure from a file and writes its label to a file.
//!
//! It runs in its own directory with `structure.extxyz` (Å) and copies of the settings' `files`. It writes
//! `label.extxyz`: one frame with the same atoms in the same order at the same positions in the same cell,
//! `energy` (eV), `forces` (eV/Å) and optionally `stress` (eV/Å³, tension positive) and the column `magmoms`
//! (μ_B). If `free_energy` is present, it is the one consistent with the forces. Exit code 0 states that the
//! calculation converged and the file is complete. Other codes are failures: 3 not converged, 4 out of memory,
//! 5 the structure cannot be calculated, any other: crashed. Its output is kept with the failure. After a
//! failure the variable `CALMWALK_RETRY_ADJUSTMENTS` lists the adjustments of the retry, separated by commas
//! (`more_steps`, `slower_mixing`, `other_algorithm`, `other_moments`, `more_memory`, `more_time`,
//! `other_node`). None of them may change the converged numbers.

mod read;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use atoms::extxyz::{Frame, write_frame};
use atoms::{Species, Structure};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::{
    CalculationInput, CalculationResults, CalculationSize, DftBackend, Exit, Failure, FailureClass,
    RetryAdjustment, SetupError, executable, validation,
};

const STRUCTURE: &str = "structure.extxyz";
const LABEL: &str = "label.extxyz";

/// File names that the user cannot choose.
const RESERVED: [&str; 4] = [STRUCTURE, LABEL, "stdout", "stderr"];

/// The settings of `[label.method.command]`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CommandSettings {
    /// The program and its arguments, one word each, without a shell. The program is an absolute path or a name
    /// to look up in PATH. Pass scripts among `files` to their interpreter: `["python3", "label.py"]`.
    pub command: Vec<String>,
    /// Files that the program needs. They are read once at the start, belong to the protocol's identity, and
    /// are copied into the directory of each calculation. Describe files that are too large for that in
    /// `version`.
    #[serde(default)]
    pub files: Vec<PathBuf>,
    /// What determines the labels beside the command and the files, in the user's words: versions of programs
    /// and models.
    pub version: String,
}

/// A configured command.
#[derive(Debug)]
pub struct Command {
    command: Vec<String>,
    files: BTreeMap<String, Vec<u8>>,
    version: String,
}

impl CommandSettings {
    /// Finds the program and reads the files.
    ///
    /// # Errors
    /// A missing program, a file that cannot be read, two files of the same name.
    pub fn prepare(&self) -> Result<Command, SetupError> {
        let Some(program) = self.command.first() else {
            let expected = "a program and its arguments, such as [\"python3\", \"label.py\"]".to_owned();
            return Err(SetupError::Setting { key: "command", found: "nothing".to_owned(), expected });
        };
        executable::find(program)?;
        let mut files = BTreeMap::new();
        for path in &self.files {
            let fault = |expected: String| SetupError::Setting {
                key: "files",
                found: path.display().to_string(),
                expected,
            };
            let content = std::fs::read(path)
                .map_err(|error| fault(format!("a file that can be read, but: {error}")))?;
            let name = path.file_name().and_then(|name| name.to_str());
            let name = name.ok_or_else(|| fault("a file with a UTF-8 name".to_owned()))?;
            if RESERVED.contains(&name) || files.insert(name.to_owned(), content).is_some() {
                return Err(fault(format!("another name: the directory has another file '{name}'")));
            }
        }
        Ok(Command { command: self.command.clone(), files, version: self.version.clone() })
    }
}

impl DftBackend for Command {
    fn identity(&self) -> serde_json::Value {
        let hash =
            |(name, content): (&String, &Vec<u8>)| (name.clone(), blake3::hash(content).to_hex().to_string());
        let files: BTreeMap<String, String> = self.files.iter().map(hash).collect();
        json!({ "code": "command", "command": self.command, "files": files, "version": self.version })
    }

    fn supports(&self, _: &BTreeSet<Species>) -> Result<(), SetupError> {
        Ok(())
    }

    fn input(
        &self,
        structure: &Structure,
        adjustments: &BTreeSet<RetryAdjustment>,
    ) -> Result<CalculationInput, Failure> {
        let mut text = Vec::new();
        write_frame(&mut text, &Frame::from(structure.clone()))
            .map_err(|error| FailureClass::BadInput.with_message(error.to_string()))?;
        let mut files = self.files.clone();
        files.insert(STRUCTURE.to_owned(), text);
        let names: Vec<_> = adjustments.iter().map(|adjustment| adjustment.name()).collect();
        let environment = BTreeMap::from([("CALMWALK_RETRY_ADJUSTMENTS".to_owned(), names.join(","))]);
        Ok(CalculationInput {
            files,
            command: self.command.clone(),
            environment,
            ..CalculationInput::default()
        })
    }

    fn read(
        &self,
        structure: &Structure,
        directory: &Path,
        exit: Exit,
    ) -> Result<CalculationResults, Failure> {
        match exit {
            Exit::Code(0) => read::label(structure, &directory.join(LABEL)),
            Exit::Code(3) => {
                Err(FailureClass::NotConverged.with_message("reported by the command (exit code 3)"))
            }
            Exit::Code(4) => {
                Err(FailureClass::OutOfMemory.with_message("reported by the command (exit code 4)"))
            }
            Exit::Code(5) => {
                Err(FailureClass::BadInput.with_message("reported by the command (exit code 5)"))
            }
            _ => Err(validation::failure_without_result(exit, directory, &["stdout", "stderr"])),
        }
    }

    fn size(&self, structure: &Structure) -> CalculationSize {
        CalculationSize { atoms: structure.len(), electrons: 0.0, k_points: 1 }
    }
}
