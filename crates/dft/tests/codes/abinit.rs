//! ABINIT.

use std::collections::BTreeMap;

use dft::abinit::AbinitSettings;
use dft::{DftBackend, FailureClass, PassedEnvironment, RetryAdjustment, Smearing};

use crate::run::{attempt, climb, label};
use crate::{checks, structures};

fn settings() -> AbinitSettings {
    AbinitSettings { cutoff: 300.0, k_spacing: 0.8, spin_polarized: false, ..AbinitSettings::default() }
}

#[test]
fn the_forces_and_the_stress_of_silicon_are_derivatives_of_its_energy() {
    // The number of plane waves changes with the cell, which adds some 2e-5 eV/Å³ at this cutoff.
    let code = AbinitSettings { cutoff: 600.0, ..settings() }.prepare(&PassedEnvironment::default()).unwrap();
    let structure = structures::silicon();
    let calculated = label(&code, &structure);
    checks::forces(&code, &structure, &calculated, 1e-3);
    checks::stress(&code, &structure, &calculated, 1e-4);
}

#[test]
fn the_forces_of_aluminium_are_derivatives_of_the_free_energy() {
    let code = AbinitSettings { smearing: Smearing::MethfesselPaxton, smearing_width: 0.2, ..settings() }
        .prepare(&PassedEnvironment::default())
        .unwrap();
    let structure = structures::aluminium();
    let calculated = label(&code, &structure);
    checks::forces(&code, &structure, &calculated, 1e-3);
}

#[test]
fn iron_is_a_magnet() {
    let pseudopotentials = "/usr/share/abinit/psp/Pseudodojo_paw_pbe_standard".into();
    let moments = BTreeMap::from([("Fe".parse().unwrap(), 3.0)]);
    let iron = AbinitSettings {
        pseudopotentials,
        initial_magnetic_moments: moments,
        spin_polarized: true,
        cutoff: 500.0,
        ..settings()
    };
    let calculated = label(&iron.prepare(&PassedEnvironment::default()).unwrap(), &structures::iron());
    checks::magnet(&calculated, 2.0, 0.2);
}

#[test]
fn too_few_steps_are_not_converged_and_the_next_rung_converges() {
    let few =
        AbinitSettings { max_scf_steps: 5, ..settings() }.prepare(&PassedEnvironment::default()).unwrap();
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
