//! What our Python scripts leave: `result.json`, whole or not at all.

use std::collections::BTreeMap;
use std::path::Path;

use atoms::cell::{Matrix3, Vec3};
use atoms::{Cell, Species, Structure};
use serde::Deserialize;

use crate::same::same_structure;
use crate::{Calculated, Failure, FailureClass, judge};

/// Numbers go to the script and back without a loss.
const DIGITS: f64 = 1e-9;

/// `result.json`: one of the first two, and versions by the names of what has made it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Outcome {
    converged: Option<Box<Converged>>,
    failure: Option<Told>,
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
struct Told {
    class: String,
    message: String,
}

/// The calculation of `structure` that was run in `directory`, by programs of these names and versions; `None` if there is
/// no whole result.
pub(crate) fn read(
    structure: &Structure,
    directory: &Path,
    by: &[(&str, &str)],
) -> Result<Option<Calculated>, Failure> {
    match judge::left(directory, "result.json")? {
        Some(bytes) => parse(structure, &bytes, by),
        None => Ok(None),
    }
}

fn parse(structure: &Structure, bytes: &[u8], by: &[(&str, &str)]) -> Result<Option<Calculated>, Failure> {
    let Ok(outcome) = serde_json::from_slice::<Outcome>(bytes) else { return Ok(None) };
    for (name, expected) in by {
        let found = outcome.by.get(*name).map_or("of an unknown version", String::as_str);
        judge::same_version(name, found, expected)?;
    }
    if let Some(Told { class, message }) = outcome.failure {
        return Err(FailureClass::named(&class).unwrap_or(FailureClass::Crashed).because(message));
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
    same_structure(structure, &found, DIGITS)?;
    let matrix = |[xx, yy, zz, yz, xz, xy]: [f64; 6]| [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
    let calculated = Calculated {
        energy,
        energy_without_smearing,
        forces,
        stress: stress.map(matrix),
        magnetic_moments: moments,
        magnetisation,
        electronic_steps: steps,
    };
    judge::numbers(&calculated, structure.len())?;
    Ok(Some(calculated))
}
