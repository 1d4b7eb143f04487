//! Reads `result.json`, which our Python scripts write atomically.

use std::collections::BTreeMap;
use std::path::Path;

use atoms::cell::{Matrix3, Vec3};
use atoms::{Cell, Species, Structure};
use serde::Deserialize;

use crate::structure_check::check_same_structure;
use crate::{CalculationResults, Failure, FailureClass, validation};

/// The script returns numbers without loss.
const TOLERANCE: f64 = 1e-9;

/// `result.json`: one of the first two fields, and the versions by program.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ScriptOutput {
    converged: Option<Box<Converged>>,
    failure: Option<ScriptFailure>,
    by: BTreeMap<String, String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Converged {
    species: Vec<Species>,
    positions: Vec<Vec3>,
    cell: Matrix3,
    energy: f64,
    energy_without_smearing: Option<f64>,
    forces: Vec<Vec3>,
    /// xx, yy, zz, yz, xz, xy
    stress: Option<[f64; 6]>,
    moments: Option<Vec<f64>>,
    magnetisation: Option<f64>,
    steps: Option<u32>,
}

#[derive(Deserialize)]
struct ScriptFailure {
    class: String,
    message: String,
}

/// Reads the calculation of `structure` in `directory`, made by programs of these names and versions; `None`
/// without a complete result.
pub(crate) fn read(
    structure: &Structure,
    directory: &Path,
    by: &[(&str, &str)],
) -> Result<Option<CalculationResults>, Failure> {
    match validation::read_output_file(directory, "result.json")? {
        Some(bytes) => parse(structure, &bytes, by),
        None => Ok(None),
    }
}

fn parse(
    structure: &Structure,
    bytes: &[u8],
    by: &[(&str, &str)],
) -> Result<Option<CalculationResults>, Failure> {
    let Ok(outcome) = serde_json::from_slice::<ScriptOutput>(bytes) else { return Ok(None) };
    for (name, expected) in by {
        let found = outcome.by.get(*name).map_or("of an unknown version", String::as_str);
        validation::check_version(name, found, expected)?;
    }
    if let Some(ScriptFailure { class, message }) = outcome.failure {
        return Err(FailureClass::from_name(&class).unwrap_or(FailureClass::Crashed).with_message(message));
    }
    let Some(result) = outcome.converged else { return Ok(None) };
    let Converged {
        species,
        positions,
        cell,
        energy,
        energy_without_smearing,
        forces,
        stress,
        moments,
        magnetisation,
        steps,
    } = *result;
    let found = Structure { species, positions, cell: Cell(cell), periodic: structure.periodic };
    check_same_structure(structure, &found, TOLERANCE)?;
    let matrix = |[xx, yy, zz, yz, xz, xy]: [f64; 6]| [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
    let calculated = CalculationResults {
        energy,
        energy_without_smearing,
        forces,
        stress: stress.map(matrix),
        magnetic_moments: moments,
        magnetisation,
        electronic_steps: steps,
    };
    validation::check_numbers(&calculated, structure.len())?;
    Ok(Some(calculated))
}
