//! Reads `run.abo` and the errors that ABINIT prints.

use std::path::Path;

use atoms::cell::{Matrix3, Vec3};
use atoms::{Cell, Species, Structure, units};

use super::{HARTREE, Smearing};
use crate::structure_check::check_same_structure;
use crate::{CalculationResults, Failure, FailureClass, validation};

/// Lattice vectors have seven decimals, bohr.
const CELL_PRECISION: f64 = 1e-6;

/// Reads the calculation of `structure` in `directory`, made by this version; `None` if the output is
/// incomplete.
pub(super) fn read(
    structure: &Structure,
    directory: &Path,
    version: &str,
    smearing: Smearing,
) -> Result<Option<CalculationResults>, Failure> {
    let text = |name| {
        let content = validation::read_output_file(directory, name)?.unwrap_or_default();
        Ok::<_, Failure>(String::from_utf8_lossy(&content).into_owned())
    };
    parse(structure, &text("run.abo")?, &text("stdout")?, version, smearing)
}

/// As [`read`], from the text of the output.
pub(super) fn parse(
    structure: &Structure,
    output: &str,
    printed: &str,
    version: &str,
    smearing: Smearing,
) -> Result<Option<CalculationResults>, Failure> {
    let calculated_by = stated_version(output);
    if let Some(found) = calculated_by {
        validation::check_version("ABINIT", found, version)?;
    }
    if let Some(message) = error(printed) {
        let class = match message.to_lowercase() {
            words if words.contains("spheres are overlapping") => FailureClass::BadInput,
            words if words.contains("memory") || words.contains("allocat") => FailureClass::OutOfMemory,
            _ => FailureClass::Crashed,
        };
        return Err(class.with_message(format!("ABINIT says: {message}")));
    }
    if !is_whole(output) {
        return Ok(None);
    }
    let steps = energies(output);
    if output.contains("was not enough SCF cycles to converge") || !output.contains(" is converged :") {
        return Err(
            FailureClass::NotConverged.with_message(format!("not in {} electronic steps", steps.len()))
        );
    }
    let unreadable =
        || FailureClass::Implausible.with_message("run.abo is complete, but its numbers cannot be read");
    calculated_by.ok_or_else(unreadable)?;
    check_same_structure(structure, &found(output).ok_or_else(unreadable)?, CELL_PRECISION)?;
    let calculated = numbers(output, &steps, smearing).ok_or_else(unreadable)?;
    validation::check_numbers(&calculated, structure.len())?;
    match last_step(printed).contains("The minimal occupation factor is") {
        true => {
            Err(FailureClass::Implausible
                .with_message("the highest band is occupied: there are too few bands"))
        }
        false => Ok(Some(calculated)),
    }
}

/// `9.6.2` from `.Version 9.6.2 of ABINIT`; `None` if the line is truncated.
fn stated_version(output: &str) -> Option<&str> {
    let (_, rest) = output.split_once(".Version ")?;
    rest.split_once(" of ABINIT").map(|(version, _)| version.trim())
}

/// Whether the output states that the calculation completed and ends with its timing.
fn is_whole(output: &str) -> bool {
    let last = output.ends_with('\n').then(|| output.lines().next_back()).flatten().unwrap_or_default();
    output.contains("Calculation completed.") && last.starts_with("+Overall time at end")
}

fn numbers(output: &str, energies: &[f64], smearing: Smearing) -> Option<CalculationResults> {
    let results = document(output, "ResultsGS")?;
    let free = *energies.last()?;
    // The summary has fewer digits but must belong to the same calculation.
    let total = value(results, "etotal")?;
    if (free - total).abs() > 2e-8 * total.abs() {
        return None;
    }
    // −TS, Hartree. Where the zero-smearing limit lies between U and F depends on the order of the smearing.
    let entropy = value(document(output, "EnergyTerms")?, "'-kT*entropy'")?;
    let order = if smearing == Smearing::MethfesselPaxton { 1.0 } else { 0.0 };
    let force = HARTREE / units::BOHR;
    Some(CalculationResults {
        energy: free * HARTREE,
        energy_without_smearing: Some((free - entropy / (2.0 + order)) * HARTREE),
        forces: rows(results, "cartesian_forces").map(|row| vector(row, force)).collect::<Option<_>>()?,
        stress: Some(matrix(results, "cartesian_stress_tensor", HARTREE / units::BOHR.powi(3))?),
        magnetic_moments: moments(output),
        magnetisation: output
            .lines()
            .rev()
            .find_map(|line| line.strip_prefix(" Total magnetization (exact up - dn):")?.trim().parse().ok()),
        electronic_steps: Some(energies.len() as u32),
    })
}

/// The structure at the end of the output.
fn found(output: &str) -> Option<Structure> {
    let results = document(output, "ResultsGS")?;
    let species = rows(results, "xred")
        .map(|row| row.split(',').nth(3)?.trim().trim_end_matches(']').trim().parse::<Species>().ok());
    let (_, end) = output.rsplit_once(" cartesian coordinates (angstrom) at end:\n")?;
    let position = |line: &str| numbers_of(line.split_whitespace().skip(1));
    Some(Structure {
        species: species.collect::<Option<_>>()?,
        positions: end
            .lines()
            .take_while(|line| !line.trim().is_empty())
            .map(position)
            .collect::<Option<_>>()?,
        cell: Cell(matrix(results, "lattice_vectors", units::BOHR)?),
        periodic: [true; 3],
    })
}

/// Total energy of each electronic step, Hartree.
fn energies(output: &str) -> Vec<f64> {
    let steps = output.lines().filter_map(|line| line.trim_start().strip_prefix("ETOT"));
    steps.filter_map(|step| step.split_whitespace().nth(1)?.parse().ok()).collect()
}

/// Last column of the table of atomic spheres, with spin the difference of the two spins, μ_B.
fn moments(output: &str) -> Option<Vec<f64>> {
    let (_, table) =
        output.rsplit_once(" Integrated electronic and magnetization densities in atomic spheres:")?;
    let rows = table.lines().skip_while(|line| !line.trim_start().starts_with("Atom ")).skip(1);
    let rows = rows.take_while(|line| !line.trim_start().starts_with("---"));
    rows.map(|row| row.split_whitespace().next_back()?.parse().ok()).collect()
}

/// The last YAML document of this kind.
fn document<'a>(output: &'a str, kind: &str) -> Option<&'a str> {
    let (_, rest) = output.rsplit_once(&format!("--- !{kind}\n"))?;
    rest.split_once("\n...").map(|(document, _)| document)
}

/// A number of a document.
fn value(document: &str, key: &str) -> Option<f64> {
    let line = document.lines().find_map(|line| line.strip_prefix(key))?;
    line.trim_start().strip_prefix(':')?.trim().parse().ok()
}

/// The rows of the list under a key.
fn rows<'a>(document: &'a str, key: &str) -> impl Iterator<Item = &'a str> {
    let lines = document.lines().skip_while(move |line| !line.starts_with(key)).skip(1);
    lines.map_while(|line| line.strip_prefix("- ["))
}

fn vector(row: &str, unit: f64) -> Option<Vec3> {
    numbers_of(row.split(',').map(str::trim)).map(|vector| vector.map(|x| x * unit))
}

fn matrix(document: &str, key: &str, unit: f64) -> Option<Matrix3> {
    let rows: Vec<Vec3> = rows(document, key).map(|row| vector(row, unit)).collect::<Option<_>>()?;
    rows.try_into().ok()
}

/// The first three numbers.
fn numbers_of<'a>(mut words: impl Iterator<Item = &'a str>) -> Option<Vec3> {
    let mut next = || words.next()?.parse().ok();
    Some([next()?, next()?, next()?])
}

/// The output from the last electronic step on.
fn last_step(printed: &str) -> &str {
    printed.rsplit_once("ITER STEP NUMBER").map_or("", |(_, rest)| rest)
}

/// The message of the first error, as one line.
fn error(printed: &str) -> Option<String> {
    let (_, rest) = printed.split_once("--- !ERROR\n").or_else(|| printed.split_once("--- !BUG\n"))?;
    let (_, message) = rest.split_once("message: |\n")?;
    let lines = message.lines().take_while(|line| !line.starts_with("...")).map(str::trim);
    let message = lines.filter(|line| !line.is_empty()).collect::<Vec<_>>().join(" ");
    Some(message.chars().take(400).collect())
}
