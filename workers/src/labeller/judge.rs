//! Which results are believed.

use atoms::Structure;
use dft::{Calculated, Failure, FailureClass};

/// A result is believed only if its numbers are finite, belong to the atoms asked for and are not absurd.
///
/// # Errors
/// [`FailureClass::Implausible`], with what is wrong.
pub fn judge(made: Calculated, structure: &Structure, largest_force: f64) -> Result<Calculated, Failure> {
    let implausible = |message: String| Err(FailureClass::Implausible.because(message));
    let expected = structure.len();
    if made.forces.len() != expected {
        return implausible(format!("{} forces for {expected} atoms", made.forces.len()));
    }
    let moments = made.magnetic_moments.as_deref().unwrap_or_default();
    if made.magnetic_moments.is_some() && moments.len() != expected {
        return implausible(format!("{} magnetic moments for {expected} atoms", moments.len()));
    }
    let stress = made.stress.iter().flatten().flatten();
    let energies = [&made.energy].into_iter().chain(&made.energy_without_smearing);
    let numbers = made.forces.iter().flatten().chain(stress).chain(energies);
    if !numbers.chain(moments).chain(&made.magnetisation).all(|x| x.is_finite()) {
        return implausible("numbers that are not finite".to_owned());
    }
    let largest = made.forces.iter().map(|f| atoms::cell::norm(*f)).fold(0.0, f64::max);
    if largest > largest_force {
        return implausible(format!("a force of {largest:.1} eV/Å, above the allowed {largest_force:.1}"));
    }
    Ok(made)
}
