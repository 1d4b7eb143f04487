//! Reads what `pw.x` prints: results and errors.

use std::path::Path;

use atoms::cell::{Matrix3, Vec3};
use atoms::{Cell, Species, Structure, units};

use super::{EspressoSettings, RYDBERG};
use crate::structure_check::check_same_structure;
use crate::{CalculationResults, Failure, FailureClass, Smearing, validation};

/// Lattice vectors have six decimals, positions seven, in a unit of 2 bohr; this is in Å.
const PRECISION: f64 = 2e-6;

/// Larger occupations of the highest band need more bands.
const MAX_OCCUPATION: f64 = 1e-3;

/// Reads the calculation of `structure` in `directory`, made by this version; `None` if the output is incomplete.
pub(super) fn read(
    structure: &Structure,
    directory: &Path,
    version: &str,
    settings: &EspressoSettings,
) -> Result<Option<CalculationResults>, Failure> {
    let printed = validation::read_output_file(directory, "stdout")?.unwrap_or_default();
    parse(structure, &String::from_utf8_lossy(&printed), version, settings)
}

/// As [`read`], from the text of the output.
pub(super) fn parse(
    structure: &Structure,
    printed: &str,
    version: &str,
    settings: &EspressoSettings,
) -> Result<Option<CalculationResults>, Failure> {
    let calculated_by = stated_version(printed);
    if let Some(found) = calculated_by {
        validation::check_version("Quantum ESPRESSO", found, version)?;
    }
    if let Some((routine, message)) = error(printed) {
        return Err(class(routine, message).with_message(format!("pw.x says: {message} ({routine})")));
    }
    if printed.contains("convergence NOT achieved after") {
        let steps = printed.lines().filter(|line| line.trim_start().starts_with("iteration #")).count();
        return Err(FailureClass::NotConverged.with_message(format!("not in {steps} electronic steps")));
    }
    if !is_whole(printed) {
        return Ok(None);
    }
    let Some(steps) = number_after(printed, "convergence has been achieved in") else {
        return Err(FailureClass::NotConverged.with_message("it does not report convergence"));
    };
    let implausible = |message: &str| FailureClass::Implausible.with_message(message);
    let unreadable = || implausible("the output is complete, but its numbers cannot be read");
    calculated_by.ok_or_else(unreadable)?;
    check_same_structure(structure, &found(printed).ok_or_else(unreadable)?, PRECISION)?;
    let calculated = numbers(printed, steps as u32, settings).ok_or_else(unreadable)?;
    validation::check_numbers(&calculated, structure.len())?;
    if highest_occupation(printed).ok_or_else(unreadable)? > MAX_OCCUPATION {
        return Err(implausible("the highest band is occupied: there are too few bands"));
    }
    Ok(Some(calculated))
}

/// `6.7MaX` from `Program PWSCF v.6.7MaX starts on`; `None` if the line is truncated.
pub(super) fn stated_version(printed: &str) -> Option<&str> {
    let (_, rest) = printed.split_once("Program PWSCF v.")?;
    let (version, _) = rest.lines().next()?.split_once(" starts on ")?;
    Some(version.trim())
}

/// Whether the program states that it ended. A launcher may print something behind.
fn is_whole(printed: &str) -> bool {
    let Some((_, rest)) = printed.rsplit_once("   JOB DONE.\n") else { return false };
    rest.split_once('\n').is_some_and(|(line, _)| line.starts_with("=-") && line.trim_end().ends_with("-="))
}

fn numbers(printed: &str, steps: u32, settings: &EspressoSettings) -> Option<CalculationResults> {
    let free = number_after(printed, "\n!    total energy              =")?;
    // −TS, Rydberg. Where the zero-smearing limit lies between U and F depends on the order of the smearing.
    let entropy = number_after(printed, "smearing contrib. (-TS)   =")?;
    let order = if settings.smearing == Smearing::MethfesselPaxton { 1.0 } else { 0.0 };
    let (_, forces) = printed.rsplit_once("Forces acting on atoms (cartesian axes, Ry/au):\n")?;
    let forces = forces.lines().skip_while(|line| line.trim().is_empty());
    let forces =
        forces.map_while(|line| line.split_once("force =").filter(|_| line.trim_start().starts_with("atom")));
    let scaled = |text: &str, unit: f64| Some(vector(text)?.map(|x| x * unit));
    Some(CalculationResults {
        energy: free * RYDBERG,
        energy_without_smearing: Some((free - entropy / (2.0 + order)) * RYDBERG),
        forces: forces.map(|(_, force)| scaled(force, RYDBERG / units::BOHR)).collect::<Option<_>>()?,
        stress: Some(stress(printed)?),
        magnetic_moments: if settings.spin_polarized { Some(moments(printed)?) } else { None },
        magnetisation: match settings.spin_polarized {
            true => Some(number_after(printed, "total magnetization       =")?),
            false => None,
        },
        electronic_steps: Some(steps),
    })
}

/// Ry/bohr³, compression positive.
fn stress(printed: &str) -> Option<Matrix3> {
    const UNIT: f64 = RYDBERG / (units::BOHR * units::BOHR * units::BOHR);
    let (_, table) = printed.rsplit_once("total   stress  (Ry/bohr**3)")?;
    let rows: Vec<Vec3> = table.lines().skip(1).take(3).map(vector).collect::<Option<_>>()?;
    let rows: Matrix3 = rows.try_into().ok()?;
    Some(rows.map(|row| row.map(|x| -UNIT * x)))
}

/// Moments inside spheres around the atoms, μ_B. Version 6 writes `magn:    0.0377`, version 7 `magn=  0.0377`.
fn moments(printed: &str) -> Option<Vec<f64>> {
    let (_, table) = printed.rsplit_once("Magnetic moment per site")?;
    let rows = table.lines().skip(1).take_while(|line| line.trim_start().starts_with("atom"));
    let moment = |row: &str| {
        let (_, value) = row.split_once("magn")?;
        value.trim_start_matches([':', '=']).split_whitespace().next()?.parse().ok()
    };
    rows.map(moment).collect()
}

/// The calculated structure.
fn found(printed: &str) -> Option<Structure> {
    let unit = number_after(printed, "lattice parameter (alat)  =")? * units::BOHR;
    let scaled = |text: &str| Some(vector(text)?.map(|x| x * unit));
    let row = |name: &str| scaled(printed.split_once(&format!(" a({name}) = ("))?.1);
    let (_, sites) = printed.split_once("positions (alat units)\n")?;
    let sites: Vec<&str> = sites.lines().take_while(|line| line.contains(" tau(")).collect();
    let species = sites.iter().map(|site| site.split_whitespace().nth(1)?.parse::<Species>().ok());
    let positions = sites.iter().map(|site| scaled(site.split_once(") = (")?.1));
    Some(Structure {
        species: species.collect::<Option<_>>()?,
        positions: positions.collect::<Option<_>>()?,
        cell: Cell([row("1")?, row("2")?, row("3")?]),
        periodic: [true; 3],
    })
}

/// Largest occupation of the highest band, over k-points and spins; 1 is full.
fn highest_occupation(printed: &str) -> Option<f64> {
    let last = |table: &str| {
        let lines = table.lines().skip(1).take_while(|line| !line.trim().is_empty());
        lines.last()?.split_whitespace().next_back()?.parse::<f64>().ok()
    };
    let occupations = printed.split("     occupation numbers").skip(1).map(last);
    let occupations: Vec<f64> = occupations.collect::<Option<_>>()?;
    occupations.into_iter().map(f64::abs).reduce(f64::max)
}

/// The number behind the last `key`.
fn number_after(printed: &str, key: &str) -> Option<f64> {
    printed.rsplit_once(key)?.1.lines().next()?.split_whitespace().next()?.parse().ok()
}

/// The first three numbers of the first line.
fn vector(text: &str) -> Option<Vec3> {
    let mut words = text.lines().next()?.split_whitespace();
    let mut next = || words.next()?.parse().ok();
    Some([next()?, next()?, next()?])
}

/// Routine and message of the first error.
fn error(printed: &str) -> Option<(&str, &str)> {
    let (_, rest) = printed.split_once("Error in routine ")?;
    let (routine, rest) = rest.split_once('\n')?;
    let message = rest.lines().map(str::trim).find(|line| !line.is_empty())?;
    let routine = routine.rsplit_once(" (").map_or(routine, |(name, _)| name);
    Some((routine.trim(), message))
}

/// The class of an error that `pw.x` reports.
fn class(routine: &str, message: &str) -> FailureClass {
    /// What eigensolvers say when they fail; the other one may not.
    const SOLVERS: [&str; 4] =
        ["bands are not converged", "cholesky", "not positive definite", "eigenvectors failed to converge"];
    let said = message.to_lowercase();
    let has = |words: &[&str]| words.iter().any(|words| said.contains(words));
    match routine {
        // Coinciding atoms.
        "check_atoms" => FailureClass::BadInput,
        _ if has(&["allocat", "memory"]) => FailureClass::OutOfMemory,
        _ if has(&SOLVERS) => FailureClass::NotConverged,
        _ => FailureClass::Crashed,
    }
}
