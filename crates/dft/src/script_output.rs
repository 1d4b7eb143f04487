//! What our Python scripts leave: `result.json`, whole or not at all.

use std::collections::BTreeMap;
use std::path::Path;

use atoms::cell::{Matrix3, Vec3};
use atoms::{Cell, Species, Structure};
use serde::Deserialize;

use crate::structure_check::check_same_structure;
use crate::{Failure, FailureClass, Results, validation};

/// Numbers go to the script and back without a loss.
const TOLERANCE: f64 = 1e-9;

/// `result.json`: one of the first two, and versions by the names of what has made it.
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

/// The calculation of `structure` that was run in `directory`, by programs of these names and versions; `None` if there is
/// no whole result.
pub(crate) fn read(
    structure: &Structure,
    directory: &Path,
    by: &[(&str, &str)],
) -> Result<Option<Results>, Failure> {
    match validation::read_output_file(directory, "result.json")? {
        Some(bytes) => parse(structure, &bytes, by),
        None => Ok(None),
    }
}

fn parse(structure: &Structure, bytes: &[u8], by: &[(&str, &str)]) -> Result<Option<Results>, Failure> {
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
    let calculated = Results {
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
