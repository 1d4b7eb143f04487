//! Checks that a program calculated the requested structure.

use atoms::cell::{norm, scale, sub};
use atoms::{Structure, Vec3};

use crate::{Failure, FailureClass};

/// Compares the structure of an output with the requested one: the same species in the same order in the same
/// cell and, modulo lattice vectors of the periodic directions, at the same positions. `tolerance`, Å, is the
/// precision of the output, for the elements of the cell and the displacement of each atom.
///
/// # Errors
/// [`FailureClass::Implausible`] with the first difference.
pub(crate) fn check_same_structure(
    asked: &Structure,
    found: &Structure,
    tolerance: f64,
) -> Result<(), Failure> {
    let other = |message: String| {
        let rest = "the calculation is not of the requested structure";
        Err(FailureClass::Implausible.with_message(format!("{message}: {rest}")))
    };
    if found.len() != asked.len() || found.positions.len() != asked.positions.len() {
        return other(format!("found {} atoms, expected {}", found.len(), asked.len()));
    }
    let pairs = || asked.species.iter().zip(&found.species);
    if let Some(atom) = pairs().position(|(asked, found)| asked != found) {
        let (found, asked) = (found.species[atom], asked.species[atom]);
        return other(format!("atom {atom} is {found}, expected {asked}"));
    }
    for i in (0..3).filter(|i| asked.periodic[*i]) {
        let (found, asked) = (found.cell.0[i], asked.cell.0[i]);
        // Written so that NaN counts as a difference.
        if !sub(found, asked).iter().all(|x| x.abs() <= tolerance) {
            return other(format!("found the lattice vector {found:?}, expected {asked:?} (Å)"));
        }
    }
    let lattice = asked.cell.completed(asked.periodic);
    for (atom, (found, position)) in found.positions.iter().zip(&asked.positions).enumerate() {
        let mut offset: Vec3 = sub(*found, *position);
        let steps = lattice.fractional(offset).map(f64::round);
        for i in (0..3).filter(|i| asked.periodic[*i]) {
            offset = sub(offset, scale(lattice.0[i], steps[i]));
        }
        let there = norm(offset) <= tolerance;
        if !there {
            return other(format!("atom {atom} is at {found:?}, expected {position:?} (Å)"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use atoms::Cell;

    fn wire() -> Structure {
        Structure {
            species: ["Al", "O"].map(|symbol| symbol.parse().unwrap()).to_vec(),
            positions: vec![[0.1, 0.2, 0.3], [2.0, 3.0, 4.0]],
            cell: Cell([[5.0, 0.0, 0.0], [1.0, 5.0, 0.0], [0.0, 0.0, 5.0]]),
            periodic: [true, true, false],
        }
    }

    fn fault(change: impl Fn(&mut Structure)) -> String {
        let mut found = wire();
        change(&mut found);
        let failure = check_same_structure(&wire(), &found, 1e-6).unwrap_err();
        assert_eq!(failure.class, FailureClass::Implausible);
        failure.message
    }

    #[test]
    fn wrapping_and_lost_digits_are_no_difference() {
        let mut found = wire();
        found.positions = vec![[5.1 + 5e-7, 0.2, 0.3], [1.0, -2.0, 4.0]];
        found.cell.0[0][1] = 5e-7;
        found.cell.0[2] = [0.0; 3];
        assert_eq!(check_same_structure(&wire(), &found, 1e-6), Ok(()));
    }

    #[test]
    fn each_difference_is_named() {
        assert!(fault(|found| found.species.swap(0, 1)).starts_with("atom 0 is O, expected Al:"));
        assert!(fault(|found| found.positions.swap(0, 1)).starts_with("atom 0 is at [2.0, 3.0, 4.0]"));
        assert!(fault(|found| found.positions[1][2] += 5.0).starts_with("atom 1 is at"));
        assert!(fault(|found| found.positions[1][0] = f64::NAN).starts_with("atom 1 is at"));
        assert!(fault(|found| found.cell.0[1][1] = 5.1).starts_with("found the lattice vector"));
        assert!(fault(|found| found.cell.0[1][1] = f64::NAN).starts_with("found the lattice vector"));
        let shorter = fault(|found| {
            found.species.pop();
            found.positions.pop();
        });
        assert!(shorter.starts_with("found 1 atoms, expected 2:"));
    }
}
