//! Which results are believed.

use analysis::EnergyOffsets;
use atoms::Structure;
use dft::{Calculated, Failure, FailureClass};
use serde::{Deserialize, Serialize};

use super::energies::labelled_energy;

/// So many labelled structures have to speak for a composition before an energy is held against them.
const LEAST_SUPPORT: f64 = 5.0;
/// eV/Å³ in GPa.
const GPA: f64 = 160.217_663_4;

/// `[label]`: the largest values that are believed of a label.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct LabelBounds {
    /// Force, eV/Å.
    pub largest_force: f64,
    /// Component of the stress, eV/Å³.
    pub largest_stress: f64,
    /// Energy, whatever its sign, eV an atom.
    pub largest_energy: f64,
    /// Difference from the potential's energy without the elements' offsets, eV an atom.
    pub largest_energy_difference: f64,
}

impl Default for LabelBounds {
    fn default() -> Self {
        Self {
            largest_force: 1000.0,
            largest_stress: 10.0,
            // No element's all-electron energy is larger.
            largest_energy: 2e6,
            largest_energy_difference: 100.0,
        }
    }
}

/// What the energy of a label is compared with.
#[derive(Clone, Copy, Debug)]
pub(super) struct Expected<'a> {
    /// Energy by the potential, eV.
    pub model: f64,
    /// Offsets of the elements, from the labels that there are.
    pub offsets: &'a EnergyOffsets,
}

/// A result is believed only if its numbers are finite, belong to the atoms asked for and are within bounds. Where too few labels
/// speak for its composition, its energy is compared with none.
///
/// # Errors
/// [`FailureClass::Implausible`], with what is wrong.
pub(super) fn judge(
    made: Calculated,
    structure: &Structure,
    bounds: &LabelBounds,
    expected: Option<Expected<'_>>,
) -> Result<Calculated, Failure> {
    let problem = wrong_number(&made, structure.len())
        .or_else(|| not_finite(&made))
        .or_else(|| beyond(&made, bounds))
        .or_else(|| too_far(&made, structure, bounds, expected?));
    match problem {
        Some(problem) => Err(FailureClass::Implausible.because(problem)),
        None => Ok(made),
    }
}

fn wrong_number(made: &Calculated, atoms: usize) -> Option<String> {
    let moments = made.magnetic_moments.as_ref().map_or(atoms, Vec::len);
    let lists = [("forces", made.forces.len()), ("magnetic moments", moments)];
    let (name, found) = lists.into_iter().find(|(_, found)| *found != atoms)?;
    Some(format!("{found} {name} for {atoms} atoms"))
}

fn not_finite(made: &Calculated) -> Option<String> {
    let energies = [Some(made.energy), made.energy_without_smearing];
    let moments = made.magnetic_moments.iter().flatten().chain(&made.magnetisation);
    let find = |name, mut numbers: &mut dyn Iterator<Item = f64>| {
        let found = (&mut numbers).find(|x| !x.is_finite())?;
        Some(format!("{name} of {found}, which is not a finite number"))
    };
    find("an energy", &mut energies.into_iter().flatten())
        .or_else(|| find("a force", &mut made.forces.iter().flatten().copied()))
        .or_else(|| find("a stress component", &mut made.stress.iter().flatten().flatten().copied()))
        .or_else(|| find("a magnetic moment", &mut moments.copied()))
}

/// Of numbers that are all finite.
fn beyond(made: &Calculated, bounds: &LabelBounds) -> Option<String> {
    let LabelBounds { largest_force, largest_stress, largest_energy, .. } = *bounds;
    let atoms = made.forces.len().max(1) as f64;
    let energies = [Some(made.energy), made.energy_without_smearing];
    let energy =
        energies.into_iter().flatten().map(|energy| energy / atoms).find(|e| e.abs() > largest_energy);
    if let Some(energy) = energy {
        let (energy, bound) = (number(energy), number(largest_energy));
        return Some(format!("an energy of {energy} eV/atom, beyond label.largest_energy = {bound} eV/atom"));
    }
    let components = made.stress.iter().flatten().flatten();
    let stress =
        components.copied().fold(0.0, |largest: f64, x| if x.abs() > largest.abs() { x } else { largest });
    if stress.abs() > largest_stress {
        let (gpa, stress, bound) = (number(stress * GPA), number(stress), number(largest_stress));
        return Some(format!(
            "a stress component of {stress} eV/Å³ ({gpa} GPa), beyond label.largest_stress = {bound} eV/Å³"
        ));
    }
    let force = made.forces.iter().map(|f| atoms::cell::norm(*f)).fold(0.0, f64::max);
    let (found, bound) = (number(force), number(largest_force));
    (force > largest_force)
        .then(|| format!("a force of {found} eV/Å, beyond label.largest_force = {bound} eV/Å"))
}

fn too_far(
    made: &Calculated,
    structure: &Structure,
    bounds: &LabelBounds,
    expected: Expected<'_>,
) -> Option<String> {
    let Expected { model, offsets } = expected;
    let label = labelled_energy(structure, model, made.energy);
    let difference = -offsets.error_per_atom(&label, LEAST_SUPPORT)?;
    let bound = bounds.largest_energy_difference;
    (difference.abs() > bound).then(|| {
        format!(
            "an energy that differs by {} eV/atom from the potential's (offsets of the elements, from {} labels, taken out), beyond \
             label.largest_energy_difference = {} eV/atom",
            number(difference),
            offsets.structures(),
            number(bound)
        )
    })
}

/// A number in a few digits, however large it is.
fn number(x: f64) -> String {
    match x.abs() {
        0.0 | 1e-2..1e7 => format!("{x:.2}").trim_end_matches('0').trim_end_matches('.').to_owned(),
        _ => format!("{x:.3e}"),
    }
}

#[cfg(test)]
mod tests;
