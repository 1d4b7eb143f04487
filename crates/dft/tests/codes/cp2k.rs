//! CP2K, with coarse grids and the smallest basis, which keep it consistent.

use dft::cp2k::Cp2kSettings;
use dft::{DftBackend, FailureClass, PassedEnvironment, RetryAdjustment};

use crate::run::{attempt, climb, label};
use crate::{checks, structures};

fn settings() -> Cp2kSettings {
    Cp2kSettings {
        basis: "SZV-MOLOPT-SR-GTH".into(),
        cutoff: 3000.0,
        relative_cutoff: 500.0,
        density_tolerance: 1e-6,
        vacuum: 4.0,
        k_spacing: 10.0,
        ..Cp2kSettings::default()
    }
}

#[test]
fn the_oxygen_molecule_is_a_magnet_in_its_own_vacuum() {
    let code = settings().prepare(&PassedEnvironment::default()).unwrap();
    let structure = structures::oxygen();
    let calculated = label(&code, &structure);
    checks::magnet(&calculated, 2.0, 0.01);
    assert_eq!(calculated.stress, None);
    checks::forces(&code, &structure, &calculated, 2e-2);
}

#[test]
fn the_stress_of_silicon_is_a_derivative_of_its_energy() {
    // At Γ only: this checks sign, unit and order.
    let code = Cp2kSettings { spin_polarized: false, cutoff: 2000.0, relative_cutoff: 400.0, ..settings() }
        .prepare(&PassedEnvironment::default())
        .unwrap();
    let structure = structures::silicon();
    let calculated = label(&code, &structure);
    checks::stress(&code, &structure, &calculated, 1e-4);
}

#[test]
fn too_few_steps_are_not_converged_and_the_next_rung_converges() {
    let few =
        Cp2kSettings { max_scf_steps: 12, ..settings() }.prepare(&PassedEnvironment::default()).unwrap();
    let (calculated, failures) = climb(&few, &structures::oxygen());
    assert_eq!(failures, [FailureClass::NotConverged]);
    let enough = settings().prepare(&PassedEnvironment::default()).unwrap();
    assert_eq!(few.identity(), enough.identity());
    // No adjustment changes the energy.
    let every = attempt(&enough, &structures::oxygen(), &RetryAdjustment::ALL.into()).unwrap();
    for other in [label(&enough, &structures::oxygen()), every] {
        assert!((calculated.energy - other.energy).abs() < 1e-4, "{calculated:?} {other:?}");
    }
}
