//! Derivatives of a program's own energy.

use atoms::Structure;
use atoms::cell::{Matrix3, add, dot, scale};
use dft::{CalculationResults, DftBackend};

use crate::run::label;
use crate::structures::strained;

/// Å: the third derivative adds some 1e-4 eV/Å, an energy converged to 1e-6 eV as much.
const DISPLACEMENT: f64 = 0.01;

/// The third derivative of silicon adds some 5e-5 eV/Å³.
const STRAIN: f64 = 0.005;

/// Compares forces, eV/Å, with the derivative of the energy along a direction in which every atom takes part.
pub fn forces(code: &dyn DftBackend, structure: &Structure, calculated: &CalculationResults, tolerance: f64) {
    let direction = |atom: usize| {
        let x = atom as f64;
        [(1.0 + 1.7 * x).sin(), (2.0 + 2.3 * x).cos(), (0.5 + 3.1 * x).sin()]
    };
    let energy = |step: f64| {
        let mut moved = structure.clone();
        for (atom, position) in moved.positions.iter_mut().enumerate() {
            *position = add(*position, scale(direction(atom), step));
        }
        label(code, &moved).energy
    };
    let expected = -(energy(DISPLACEMENT) - energy(-DISPLACEMENT)) / (2.0 * DISPLACEMENT);
    let found: f64 =
        calculated.forces.iter().enumerate().map(|(atom, force)| dot(*force, direction(atom))).sum();
    println!("{} forces: {found:.5} against {expected:.5} eV/Å", structure.formula());
    println!("{:?} steps, {:?}", calculated.electronic_steps, calculated.forces);
    assert!(expected.abs() > 20.0 * tolerance, "the forces are too small for this test: {expected}");
    assert!((found - expected).abs() < tolerance, "{found} against {expected} eV/Å");
}

/// Compares the stress, eV/Å³, with the derivative of the energy along a strain of all components.
pub fn stress(code: &dyn DftBackend, structure: &Structure, calculated: &CalculationResults, tolerance: f64) {
    const DIRECTION: Matrix3 = [[0.7, 0.3, -0.2], [0.3, 0.5, 0.4], [-0.2, 0.4, -0.3]];
    let energy = |step: f64| label(code, &strained(structure, &DIRECTION.map(|row| scale(row, step)))).energy;
    let expected = (energy(STRAIN) - energy(-STRAIN)) / (2.0 * STRAIN * structure.cell.volume());
    let stress = calculated.stress.expect("a periodic structure has a stress");
    let found: f64 = stress.iter().zip(&DIRECTION).map(|(a, b)| dot(*a, *b)).sum();
    println!("{} stress: {found:.6} against {expected:.6} eV/Å³", structure.formula());
    assert!(expected.abs() > 4.0 * tolerance, "the stress is too small for this test: {expected}");
    assert!((found - expected).abs() < tolerance, "{found} against {expected} eV/Å³");
}

/// Compares the moment, μ_B.
pub fn magnet(calculated: &CalculationResults, expected: f64, tolerance: f64) {
    let moment = calculated.magnetisation.expect("calculated with spin");
    println!("moment: {moment:.4} μ_B, {:?}", calculated.magnetic_moments);
    assert!((moment - expected).abs() < tolerance, "{moment} instead of {expected} μ_B");
    let atoms: f64 = calculated.magnetic_moments.as_ref().expect("calculated with spin").iter().sum();
    assert!(
        (atoms / moment - 1.0).abs() < 0.35,
        "the moments of the atoms add up to {atoms} of {moment} μ_B"
    );
}
