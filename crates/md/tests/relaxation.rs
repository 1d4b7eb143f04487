//! Relaxation ends where no force acts.

use atoms::cell::{norm, sub};
use md::Fire;

use crate::common::{LennardJones, Springs, argon_crystal};

#[test]
fn springs_return_to_their_sites() {
    let mut structure = argon_crystal(1);
    let sites = structure.positions.clone();
    for (k, r) in structure.positions.iter_mut().enumerate() {
        *r = [r[0] + 0.3, r[1] - 0.1 * k as f64, r[2] + 0.05];
    }
    let fire = Fire { max_force: 1e-8, max_steps: 1000 };
    let relaxed = fire.relax(structure, &mut Springs::new(sites.clone(), 2.5), &|| false).unwrap();
    assert!(relaxed.is_converged && relaxed.steps < 300, "{} steps", relaxed.steps);
    for (r, site) in relaxed.structure.positions.iter().zip(&sites) {
        assert!(norm(sub(*r, *site)) < 1e-8);
    }
    assert!(relaxed.evaluation.energy() < 1e-15);
}

/// The perfect crystal is a minimum, so displaced atoms return to it up to a common translation.
#[test]
fn a_disturbed_crystal_becomes_perfect_again() {
    let (perfect, mut potential) = (argon_crystal(2), LennardJones::argon());
    let fire = Fire { max_force: 1e-6, max_steps: 1000 };
    let expected = fire.relax(perfect.clone(), &mut potential, &|| false).unwrap();
    assert_eq!((expected.steps, expected.is_converged), (0, true));
    let mut disturbed = perfect.clone();
    for (k, r) in disturbed.positions.iter_mut().enumerate() {
        *r = std::array::from_fn(|axis| r[axis] + 0.2 * (1.7 * (3 * k + axis) as f64).sin());
    }
    let relaxed = fire.relax(disturbed, &mut potential, &|| false).unwrap();
    assert!(relaxed.is_converged && relaxed.structure.cell == perfect.cell, "{} steps", relaxed.steps);
    assert!((relaxed.evaluation.energy() - expected.evaluation.energy()).abs() < 1e-9);
    let unfinished =
        Fire { max_steps: 3, ..fire }.relax(relaxed.structure, &mut potential, &|| true).unwrap();
    assert_eq!(unfinished.steps, 0);
}
