//! GPAW. Real-space grids for densities cause an egg-box error of some 1e-4 eV/Å.

use dft::gpaw::GpawSettings;
use dft::{DftBackend, FailureClass, PassedEnvironment, RetryAdjustment};

use crate::run::{attempt, climb, label};
use crate::{checks, structures};

fn settings() -> GpawSettings {
    GpawSettings { cutoff: 250.0, k_spacing: 1.2, spin_polarized: false, ..GpawSettings::default() }
}

#[test]
fn the_stress_of_silicon_is_a_derivative_of_the_energy() {
    // The number of plane waves changes with the cell, which adds some 1e-4 eV/Å³ at this cutoff and mesh.
    let code = GpawSettings { cutoff: 400.0, k_spacing: 0.8, ..settings() }
        .prepare(&PassedEnvironment::default())
        .unwrap();
    let structure = structures::silicon();
    let calculated = label(&code, &structure);
    assert!(calculated.magnetic_moments.is_none());
    checks::stress(&code, &structure, &calculated, 2e-4);
}

#[test]
fn the_forces_of_aluminium_are_derivatives_of_the_free_energy() {
    let code = GpawSettings { k_spacing: 0.9, ..settings() }.prepare(&PassedEnvironment::default()).unwrap();
    let structure = structures::aluminium();
    let calculated = label(&code, &structure);
    let extrapolated = calculated.energy_without_smearing.unwrap();
    assert!((1e-3..0.1).contains(&(extrapolated - calculated.energy)), "{calculated:?}");
    checks::forces(&code, &structure, &calculated, 2e-3);
}

#[test]
fn the_oxygen_molecule_is_a_magnet_in_its_own_vacuum() {
    let code = GpawSettings { spin_polarized: true, cutoff: 300.0, vacuum: 4.0, ..settings() }
        .prepare(&PassedEnvironment::default())
        .unwrap();
    let structure = structures::oxygen();
    let calculated = label(&code, &structure);
    checks::magnet(&calculated, 2.0, 0.01);
    assert_eq!(calculated.stress, None);
    checks::forces(&code, &structure, &calculated, 2e-2);
}

#[test]
fn too_few_steps_are_not_converged_and_the_next_rung_converges() {
    let few =
        GpawSettings { max_scf_steps: 12, ..settings() }.prepare(&PassedEnvironment::default()).unwrap();
    let (calculated, failures) = climb(&few, &structures::silicon());
    assert_eq!(failures, [FailureClass::NotConverged]);
    let enough = settings().prepare(&PassedEnvironment::default()).unwrap();
    assert_eq!(few.identity(), enough.identity());
    // No adjustment changes the energy.
    let every = attempt(&enough, &structures::silicon(), &RetryAdjustment::ALL.into()).unwrap();
    for other in [label(&enough, &structures::silicon()), every] {
        assert!((calculated.energy - other.energy).abs() < 1e-5, "{calculated:?} {other:?}");
    }
}
