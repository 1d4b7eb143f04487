//! Validation of results.

use atoms::cell::norm;
use atoms::{Matrix3, Structure, Vec3};
use dft::{CalculationResults, Failure, FailureClass};
use monitor::energy_offsets::labelled_energy;
use serde::{Deserialize, Serialize};

use super::energies::EnergyReference;

/// Minimum number of labelled structures that must support a composition before energies are compared for it.
const MIN_SUPPORT: f64 = 5.0;
/// eV/Å³ in GPa.
const GPA: f64 = 160.217_663_4;

/// `[label]`: upper bounds for the values of a valid label.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct LabelBounds {
    /// Force, eV/Å.
    pub max_force: f64,
    /// Stress component, eV/Å³.
    pub max_stress: f64,
    /// Absolute energy per atom, eV.
    pub max_energy_per_atom: f64,
    /// Difference per atom from the potential's energy after removing the elements' offsets, eV.
    pub max_energy_difference_per_atom: f64,
}

impl Default for LabelBounds {
    fn default() -> Self {
        Self {
            max_force: 1000.0,
            max_stress: 10.0,
            // No element has a larger all-electron energy.
            max_energy_per_atom: 2e6,
            max_energy_difference_per_atom: 100.0,
        }
    }
}

impl LabelBounds {
    /// The bound that finite values of a label exceed, as text. Takes energy, eV; forces, [n], eV/Å; stress, eV/Å³.
    pub fn rejects(&self, energy: f64, forces: &[Vec3], stress: Option<&Matrix3>) -> Option<String> {
        let larger = |largest: f64, x: f64| if x.abs() > largest.abs() { x } else { largest };
        let stress = stress.into_iter().flatten().flatten().copied().fold(0.0, larger);
        let force = forces.iter().map(|force| norm(*force)).fold(0.0, f64::max);
        self.exceeded_energy(energy, forces.len())
            .or_else(|| self.exceeded_stress(stress))
            .or_else(|| self.exceeded_force(force))
    }

    fn exceeded_energy(&self, energy: f64, atoms: usize) -> Option<String> {
        let (energy, bound) = (energy / atoms.max(1) as f64, self.max_energy_per_atom);
        let (found, largest) = (number(energy), number(bound));
        (energy.abs() > bound).then(|| {
            format!("an energy of {found} eV/atom, beyond label.max_energy_per_atom = {largest} eV/atom")
        })
    }

    fn exceeded_stress(&self, stress: f64) -> Option<String> {
        let bound = self.max_stress;
        let (gpa, found, largest) = (number(stress * GPA), number(stress), number(bound));
        (stress.abs() > bound).then(|| {
            format!(
                "a stress component of {found} eV/Å³ ({gpa} GPa), beyond label.max_stress = {largest} eV/Å³"
            )
        })
    }

    fn exceeded_force(&self, force: f64) -> Option<String> {
        let (found, largest) = (number(force), number(self.max_force));
        (force > self.max_force)
            .then(|| format!("a force of {found} eV/Å, beyond label.max_force = {largest} eV/Å"))
    }
}

/// Validates a result: its numbers must be finite, match the number of atoms and be within bounds. The energy is
/// compared with the reference only if enough labels support its composition.
///
/// # Errors
/// [`FailureClass::Implausible`], with what is wrong.
pub(super) fn validate(
    results: CalculationResults,
    structure: &Structure,
    bounds: &LabelBounds,
    expected: Option<EnergyReference<'_>>,
) -> Result<CalculationResults, Failure> {
    let problem = wrong_length(&results, structure.len())
        .or_else(|| non_finite(&results))
        .or_else(|| bounds.rejects(results.energy, &results.forces, results.stress.as_ref()))
        .or_else(|| bounds.exceeded_energy(results.energy_without_smearing?, structure.len()))
        .or_else(|| energy_mismatch(&results, structure, bounds, expected?));
    match problem {
        Some(problem) => Err(FailureClass::Implausible.with_message(problem)),
        None => Ok(results),
    }
}

fn wrong_length(results: &CalculationResults, atoms: usize) -> Option<String> {
    let moments = results.magnetic_moments.as_ref().map_or(atoms, Vec::len);
    let lists = [("forces", results.forces.len()), ("magnetic moments", moments)];
    let (name, found) = lists.into_iter().find(|(_, found)| *found != atoms)?;
    Some(format!("{found} {name} for {atoms} atoms"))
}

fn non_finite(results: &CalculationResults) -> Option<String> {
    let energies = [Some(results.energy), results.energy_without_smearing];
    let moments = results.magnetic_moments.iter().flatten().chain(&results.magnetisation);
    let find = |name, mut numbers: &mut dyn Iterator<Item = f64>| {
        let found = (&mut numbers).find(|x| !x.is_finite())?;
        Some(format!("{name} of {found}, which is not a finite number"))
    };
    find("an energy", &mut energies.into_iter().flatten())
        .or_else(|| find("a force", &mut results.forces.iter().flatten().copied()))
        .or_else(|| find("a stress component", &mut results.stress.iter().flatten().flatten().copied()))
        .or_else(|| find("a magnetic moment", &mut moments.copied()))
}

fn energy_mismatch(
    results: &CalculationResults,
    structure: &Structure,
    bounds: &LabelBounds,
    expected: EnergyReference<'_>,
) -> Option<String> {
    let EnergyReference { model, offsets } = expected;
    let label = labelled_energy(structure, model, results.energy);
    let difference = -offsets.error_per_atom(&label, MIN_SUPPORT)?;
    let bound = bounds.max_energy_difference_per_atom;
    (difference.abs() > bound).then(|| {
        format!(
            "an energy that differs by {} eV/atom from the potential's (offsets of the elements, from {} labels, taken out), beyond \
             label.max_energy_difference_per_atom = {} eV/atom",
            number(difference),
            offsets.structures(),
            number(bound)
        )
    })
}

/// Formats a number of any size with few digits.
fn number(x: f64) -> String {
    match x.abs() {
        0.0 | 1e-2..1e7 => format!("{x:.2}").trim_end_matches('0').trim_end_matches('.').to_owned(),
        _ => format!("{x:.3e}"),
    }
}

#[cfg(test)]
mod tests;
