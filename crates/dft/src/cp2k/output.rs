//! Reads `run.out`.

use std::path::Path;

use atoms::cell::{Matrix3, Vec3};
use atoms::{Cell, Species, Structure, units};

use super::{BOHR, HARTREE, OUTPUT};
use crate::structure_check::check_same_structure;
use crate::{CalculationResults, Failure, FailureClass, validation};

/// Lattice vectors have three decimals, Å, positions six.
const CELL_PRECISION: f64 = 1e-3;
const POSITION_PRECISION: f64 = 2e-6;
/// The volume has six decimals, Å³.
const VOLUME_PRECISION: f64 = 1e-5;

/// Reads the calculation of `structure` in `directory`, made by this version; `None` if the output is
/// incomplete.
pub(super) fn read(
    structure: &Structure,
    directory: &Path,
    version: &str,
) -> Result<Option<CalculationResults>, Failure> {
    let output = validation::read_output_file(directory, OUTPUT)?.unwrap_or_default();
    parse(structure, &String::from_utf8_lossy(&output), version)
}

/// As [`read`], from the text of the output.
pub(super) fn parse(
    structure: &Structure,
    output: &str,
    version: &str,
) -> Result<Option<CalculationResults>, Failure> {
    let calculated_by = stated_version(output);
    if let Some(found) = calculated_by {
        validation::check_version("CP2K", found, version)?;
    }
    let steps = steps(output);
    // Newer versions abort in this case.
    if output.contains("SCF run NOT converged") {
        return Err(
            FailureClass::NotConverged.with_message(format!("not in {} electronic steps", steps.len()))
        );
    }
    if let Some(message) = abort(output) {
        return Err(FailureClass::Crashed.with_message(format!("CP2K says: {message}")));
    }
    if !is_whole(output) {
        return Ok(None);
    }
    if !output.contains("*** SCF run converged in") {
        return Err(FailureClass::NotConverged.with_message("it does not report convergence"));
    }
    let implausible = |message: String| FailureClass::Implausible.with_message(message);
    let unreadable = || implausible(format!("{OUTPUT} is complete, but its numbers cannot be read"));
    calculated_by.ok_or_else(unreadable)?;
    let (found, volume) = found(output).ok_or_else(unreadable)?;
    check_same_structure(structure, &found, CELL_PRECISION)?;
    check_same_structure(structure, &Structure { cell: structure.cell, ..found }, POSITION_PRECISION)?;
    if (volume - structure.cell.volume()).abs() > VOLUME_PRECISION {
        return Err(implausible(format!("the cell has {volume} Å³, not {}", structure.cell.volume())));
    }
    if last_step(output, &steps).contains("includes the last MO") {
        return Err(implausible("the highest orbital is occupied: there are too few orbitals".into()));
    }
    let calculated = numbers(output, steps.len() as u32).ok_or_else(unreadable)?;
    validation::check_numbers(&calculated, structure.len())?;
    Ok(Some(calculated))
}

/// `2023.1`; `None` if the line is truncated.
fn stated_version(output: &str) -> Option<&str> {
    let (line, _) = output.split_once("CP2K| version string:")?.1.split_once('\n')?;
    line.split_whitespace().next_back()
}

/// Whether the last line states that the program ended.
fn is_whole(output: &str) -> bool {
    let last =
        output.ends_with('\n').then(|| output.trim_end().lines().next_back()).flatten().unwrap_or_default();
    output.contains("PROGRAM ENDED AT") && last.contains("PROGRAM STOPPED IN")
}

fn numbers(output: &str, steps: u32) -> Option<CalculationResults> {
    let energy: f64 = word_after(output, "ENERGY| Total FORCE_EVAL ( QS ) energy [a.u.]:")?.parse().ok()?;
    // −TS. The zero-smearing limit is halfway between free and internal energy.
    let entropy: f64 = word_after(output, "Electronic entropic energy:")?.parse().ok()?;
    let (_, forces) = output.rsplit_once("ATOMIC FORCES in [a.u.]")?;
    let forces = forces.lines().skip_while(|line| !line.trim_start().starts_with('#')).skip(1);
    let forces = forces.take_while(|line| !line.trim_start().starts_with("SUM"));
    let moments = moments(output);
    Some(CalculationResults {
        energy: energy * HARTREE,
        energy_without_smearing: Some((energy - 0.5 * entropy) * HARTREE),
        forces: forces
            .map(|line| Some(vector(line, 3)?.map(|x| x * HARTREE / BOHR)))
            .collect::<Option<_>>()?,
        stress: Some(stress(output)?),
        magnetisation: moments.as_ref().map(|moments| moments.iter().sum()),
        magnetic_moments: moments,
        electronic_steps: Some(steps),
    })
}

/// GPa, compression positive.
fn stress(output: &str) -> Option<Matrix3> {
    let (_, table) = output.rsplit_once("STRESS| Analytical stress tensor [GPa]\n")?;
    let rows = table.lines().skip(1).take(3).map(|line| vector(line, 2));
    let rows: Vec<Vec3> = rows.collect::<Option<_>>()?;
    let rows: [Vec3; 3] = rows.try_into().ok()?;
    Some(rows.map(|row| row.map(|x| -x / units::GPA_PER_EV_A3)))
}

/// Mulliken's moments, if the table has their column, μ_B.
fn moments(output: &str) -> Option<Vec<f64>> {
    let (_, table) = output.rsplit_once("Mulliken Population Analysis")?;
    let mut lines = table.lines().skip_while(|line| !line.trim_start().starts_with('#'));
    if !lines.next()?.contains("Spin moment") {
        return None;
    }
    let rows = lines.take_while(|line| !line.trim_start().starts_with('#'));
    rows.map(|row| row.split_whitespace().next_back()?.parse().ok()).collect()
}

/// The structure and its volume, Å³.
fn found(output: &str) -> Option<(Structure, f64)> {
    let volume = word_after(output, " CELL| Volume [angstrom^3]:")?.parse().ok()?;
    let row = |name: &str| vector(output.split(&format!(" CELL| Vector {name} [angstrom]:")).nth(1)?, 0);
    let (_, table) = output.rsplit_once("ATOMIC COORDINATES IN ANGSTROM")?;
    let rows = table.lines().skip_while(|line| !line.trim_start().starts_with("Atom")).skip(1);
    let rows: Vec<&str> = rows.take_while(|line| !line.trim().is_empty()).collect();
    let species = rows.iter().map(|row| row.split_whitespace().nth(2)?.parse::<Species>().ok());
    let structure = Structure {
        species: species.collect::<Option<_>>()?,
        positions: rows.iter().map(|row| vector(row, 4)).collect::<Option<_>>()?,
        cell: Cell([row("a")?, row("b")?, row("c")?]),
        periodic: [true; 3],
    };
    Some((structure, volume))
}

/// The lines of the electronic steps.
fn steps(output: &str) -> Vec<&str> {
    let Some((_, table)) = output.split_once("SCF WAVEFUNCTION OPTIMIZATION") else { return Vec::new() };
    let is_step = |line: &&str| {
        let mut words = line.split_whitespace();
        words.next().is_some_and(|word| word.parse::<u32>().is_ok())
            && words
                .next()
                .is_some_and(|word| word.contains("Mix") || word.contains("Diag") || word.contains('/'))
    };
    let end = table.find("*** SCF run").unwrap_or(table.len());
    table[..end].lines().filter(is_step).collect()
}

/// The output between the last two electronic steps.
fn last_step<'a>(output: &'a str, steps: &[&str]) -> &'a str {
    let [.., before, last] = steps else { return "" };
    let begin = output.find(before).unwrap_or_default();
    output[begin..].split_once(last).map_or("", |(between, _)| between)
}

/// Three numbers of a line, from word `skip` on.
fn vector(line: &str, skip: usize) -> Option<Vec3> {
    let mut words = line.lines().next()?.split_whitespace().skip(skip);
    let mut next = || words.next()?.parse().ok();
    Some([next()?, next()?, next()?])
}

/// The last word of the last line with this key.
fn word_after<'a>(output: &'a str, key: &str) -> Option<&'a str> {
    output.rsplit_once(key)?.1.lines().next()?.split_whitespace().next_back()
}

/// The text in the box of an abort, as one line.
fn abort(output: &str) -> Option<String> {
    let (_, rest) = output.split_once("[ABORT]")?;
    let lines = rest.lines().take_while(|line| !line.trim_start().starts_with("***"));
    let words =
        lines.flat_map(|line| line.split_whitespace().filter(|word| word.chars().any(char::is_alphanumeric)));
    Some(words.filter(|word| !["O/|"].contains(word)).collect::<Vec<_>>().join(" "))
}
