//! Any calculator of the Atomic Simulation Environment, in the user's Python, run by our script ([`SCRIPT`]).
//!
//! The script reads `input.json` and the user's `calculator.py` in its directory and writes `result.json`
//! atomically. `input.json` has `species`, `positions` and `cell` (Å), `periodic`, `moments` (μ_B, or null) and
//! `retry_adjustments`, their names. `result.json` is either `{"converged": {…}}` with `species`,
//! `positions`, `cell`, `energy` (eV, the one consistent with the forces), `energy_without_smearing`, `forces`
//! (eV/Å), `stress` (eV/Å³, xx yy zz yz xz xy), `moments`, `magnetisation` (μ_B) and `steps`, null where
//! absent; or `{"failure": {"class": …, "message": …}}`. In both cases `by` has the versions of ASE and of the
//! calculator's file, which must match the protocol.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use atoms::{Species, Structure};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::moments::{self, InitialMagneticMoments};
use crate::{
    CalculationInput, CalculationResults, CalculationSize, DftBackend, Exit, Failure, FailureClass,
    PassedEnvironment, RetryAdjustment, SetupError, script_output, validation, version_query,
};

/// The script that runs the calculator.
pub const SCRIPT: &str = concat!(include_str!("script.py"), include_str!("ase/job.py"));

const SCRIPT_FILE: &str = "job.py";
const CALCULATOR_FILE: &str = "calculator.py";

/// Version of the script; raised when a change affects label values.
const INPUT_VERSION: u32 = 1;

/// The settings of `[label.method.ase]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
#[schemars(extend("required" = ["calculator"]))]
pub struct AseSettings {
    /// A Python with ASE and its launcher: `["mpirun", "-np", "4", "gpaw", "python"]`.
    pub command: Vec<String>,
    /// Additional environment variables. Default: `OMP_NUM_THREADS=1`.
    pub environment: BTreeMap<String, String>,
    /// A Python file that defines `calculator()`, which returns an ASE calculator. If the function has a
    /// parameter, it receives the set of retry adjustments by name. The file may define a string `version` for
    /// everything else that labels depend on, and `converged(calculator)`. It is read once at the start and
    /// copied alone into each calculation's directory. Required.
    pub calculator: PathBuf,
    /// Initial magnetic moment of each element, μ_B. Default: 1 for the elements not listed; without this table
    /// no atom has a moment.
    pub initial_magnetic_moments: InitialMagneticMoments,
}

impl Default for AseSettings {
    fn default() -> Self {
        Self {
            command: vec!["python3".into()],
            environment: BTreeMap::new(),
            calculator: PathBuf::new(),
            initial_magnetic_moments: InitialMagneticMoments::new(),
        }
    }
}

impl AseSettings {
    /// Reads the calculator's file and queries the versions.
    ///
    /// # Errors
    /// A missing file, a program that is not Python with ASE, a file that Python cannot load.
    pub fn prepare(&self, passed: &PassedEnvironment) -> Result<Ase, SetupError> {
        let calculator = std::fs::read(&self.calculator).map_err(|error| SetupError::Setting {
            key: "calculator",
            found: self.calculator.display().to_string(),
            expected: format!("a Python file that defines calculator(), but: {error}"),
        })?;
        let environment = version_query::environment(&self.environment);
        let versions = AseVersions::query(&self.command, &environment, passed, &calculator)?;
        Ok(Ase { settings: self.clone(), environment, calculator, versions })
    }
}

/// The versions of ASE and of the calculator's file, as the script reports them.
#[derive(Clone, Debug, Deserialize)]
struct AseVersions {
    ase: String,
    version: String,
}

impl AseVersions {
    fn query(
        command: &[String],
        environment: &BTreeMap<String, String>,
        passed: &PassedEnvironment,
        calculator: &[u8],
    ) -> Result<Self, SetupError> {
        let files = [(SCRIPT_FILE, SCRIPT.as_bytes()), (CALCULATOR_FILE, calculator)];
        let said = version_query::run(command, &[SCRIPT_FILE], environment, passed, &files)?;
        said.lines().rev().find_map(|line| serde_json::from_str(line).ok()).ok_or_else(|| {
            let reason = format!("is not a Python with ASE: expected its version, found {:?}", said.trim());
            version_query::wrong_program(command, reason)
        })
    }
}

/// A configured calculator.
#[derive(Clone, Debug)]
pub struct Ase {
    settings: AseSettings,
    environment: BTreeMap<String, String>,
    calculator: Vec<u8>,
    versions: AseVersions,
}

impl DftBackend for Ase {
    fn identity(&self) -> Value {
        // Destructure, so that a new setting cannot be forgotten here.
        let AseSettings { command: _, environment: _, calculator: _, initial_magnetic_moments: moments } =
            &self.settings;
        json!({
            "code": "ase", "ase": self.versions.ase, "recipe": INPUT_VERSION, "version": self.versions.version,
            "calculator": blake3::hash(&self.calculator).to_hex().to_string(), "moments": moments,
        })
    }

    fn supports(&self, _: &BTreeSet<Species>) -> Result<(), SetupError> {
        // Only the calculator knows, and only while it calculates.
        Ok(())
    }

    fn input(
        &self,
        structure: &Structure,
        adjustments: &BTreeSet<RetryAdjustment>,
    ) -> Result<CalculationInput, Failure> {
        structure.validate().map_err(|error| FailureClass::BadInput.with_message(error.to_string()))?;
        let table = &self.settings.initial_magnetic_moments;
        let task = json!({
            "species": structure.species,
            "positions": structure.positions,
            "cell": structure.cell.0,
            "periodic": structure.periodic,
            "moments": (!table.is_empty()).then(|| moments::initial(structure, table, adjustments)),
            "retry_adjustments": adjustments.iter().map(|adjustment| adjustment.name()).collect::<Vec<_>>(),
        });
        let files = [
            (SCRIPT_FILE, SCRIPT.into()),
            (CALCULATOR_FILE, self.calculator.clone()),
            ("input.json", task.to_string().into_bytes()),
        ];
        Ok(CalculationInput {
            files: files.map(|(name, content)| (name.to_owned(), content)).into(),
            command: self.settings.command.iter().cloned().chain([SCRIPT_FILE.to_owned()]).collect(),
            environment: self.environment.clone(),
            ..CalculationInput::default()
        })
    }

    fn read(
        &self,
        structure: &Structure,
        directory: &Path,
        exit: Exit,
    ) -> Result<CalculationResults, Failure> {
        let by = [("ase", self.versions.ase.as_str()), ("version", self.versions.version.as_str())];
        match script_output::read(structure, directory, &by)? {
            Some(calculated) => Ok(calculated),
            None => Err(validation::failure_without_result(exit, directory, &["stdout", "stderr"])),
        }
    }

    fn size(&self, structure: &Structure) -> CalculationSize {
        CalculationSize { atoms: structure.len(), electrons: 0.0, k_points: 1 }
    }
}

#[cfg(test)]
mod tests;
