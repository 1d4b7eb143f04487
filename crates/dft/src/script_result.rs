//! What our Python scripts leave: `result.json`, whole or not at all.

use std::path::Path;

use atoms::cell::{Matrix3, Vec3};
use atoms::{Cell, Species, Structure};
use serde::Deserialize;

use crate::same::same_structure;
use crate::{Calculated, Failure, FailureClass, judge};

/// Numbers go to the script and back without a loss.
const DIGITS: f64 = 1e-9;

/// `result.json`
#[derive(Deserialize)]
#[serde(rename_all = "snake_case")]
enum Outcome {
    Converged(Box<Converged>),
    Failure(Told),
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

/// The calculation of `structure` that was run in `directory`; `None` if there is no whole result.
pub(crate) fn read(structure: &Structure, directory: &Path) -> Result<Option<Calculated>, Failure> {
    match std::fs::read(directory.join("result.json")) {
        Ok(bytes) => parse(structure, &bytes),
        Err(_) => Ok(None),
    }
}

fn parse(structure: &Structure, bytes: &[u8]) -> Result<Option<Calculated>, Failure> {
    let result = match serde_json::from_slice(bytes) {
        Ok(Outcome::Converged(result)) => result,
        Ok(Outcome::Failure(Told { class, message })) => {
            return Err(FailureClass::named(&class).unwrap_or(FailureClass::Crashed).because(message));
        }
        Err(_) => return Ok(None),
    };
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
