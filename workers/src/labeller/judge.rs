//! Which labels are believed.

use store::records::{Label, Lease};

use super::LabelFailure;

/// A label is believed only if its numbers are finite, belong to the atoms asked for and are not absurd.
pub(super) fn judge(label: Label, lease: &Lease, largest_force: f64) -> Result<Label, LabelFailure> {
    let (found, expected) = (label.forces.len(), lease.structure.len());
    if found != expected {
        return Err(LabelFailure::Implausible(format!("{found} forces for {expected} atoms")));
    }
    let stress = label.stress.iter().flatten().flatten();
    if !label.forces.iter().flatten().chain(stress).chain([&label.energy]).all(|x| x.is_finite()) {
        return Err(LabelFailure::Implausible("numbers that are not finite".to_owned()));
    }
    let largest = label.forces.iter().map(|f| atoms::cell::norm(*f)).fold(0.0, f64::max);
    if largest > largest_force {
        let message = format!("a force of {largest:.1} eV/Å, above the allowed {largest_force:.1}");
        return Err(LabelFailure::Implausible(message));
    }
    Ok(label)
}
