//! Quantum ESPRESSO, with what Debian's package has: norm-conserving silicon, ultrasoft iron and oxygen.

use std::collections::BTreeMap;

use dft::espresso::{Espresso, EspressoSettings};
use dft::{DftBackend, FailureClass, PassedEnvironment, RetryAdjustment, Smearing};

use crate::run::{attempt, climb, label};
use crate::{checks, structures};

fn settings() -> EspressoSettings {
    let files = [("Si", "Si.pbe-rrkj.UPF"), ("Fe", "Fe.pbe-nd-rrkjus.UPF"), ("O", "O.pbe-rrkjus.UPF")];
    let variants = files.map(|(symbol, file)| (symbol.parse().unwrap(), file.to_owned()));
    EspressoSettings {
        pseudopotential_variants: variants.into(),
        cutoff: 300.0,
        k_spacing: 0.8,
        spin_polarized: false,
        ..EspressoSettings::default()
    }
}

fn prepared(settings: EspressoSettings) -> Espresso {
    settings.prepare(&PassedEnvironment::default()).unwrap()
}

#[test]
fn the_forces_and_the_stress_of_silicon_are_derivatives_of_its_energy() {
    let code = prepared(EspressoSettings { cutoff: 600.0, ..settings() });
    let structure = structures::silicon();
    let calculated = label(&code, &structure);
    checks::forces(&code, &structure, &calculated, 1e-3);
    checks::stress(&code, &structure, &calculated, 1e-4);
}

/// At 3500 K, where internal and free energy differ by 0.1 eV.
#[test]
fn the_forces_of_hot_silicon_are_derivatives_of_the_free_energy() {
    let hot = EspressoSettings { smearing: Smearing::FermiDirac, smearing_width: 0.3, ..settings() };
    let code = prepared(hot);
    let structure = structures::silicon();
    let calculated = label(&code, &structure);
    assert!(calculated.energy_without_smearing.unwrap() - calculated.energy > 0.05, "{calculated:?}");
    checks::forces(&code, &structure, &calculated, 3e-4);
}

#[test]
fn iron_is_a_magnet() {
    let moments = BTreeMap::from([("Fe".parse().unwrap(), 3.0)]);
    let iron = EspressoSettings {
        initial_magnetic_moments: moments,
        spin_polarized: true,
        cutoff: 400.0,
        ..settings()
    };
    let calculated = label(&prepared(iron), &structures::iron());
    checks::magnet(&calculated, 2.0, 0.2);
}

#[test]
fn the_oxygen_molecule_has_two_unpaired_electrons_in_its_own_vacuum() {
    let molecule = EspressoSettings { spin_polarized: true, cutoff: 400.0, vacuum: 4.0, ..settings() };
    let code = prepared(molecule);
    let structure = structures::oxygen();
    let calculated = label(&code, &structure);
    // The spheres of the atoms hold less than two thirds of it.
    assert!((calculated.magnetisation.unwrap() - 2.0).abs() < 0.015, "{calculated:?}");
    assert_eq!(calculated.stress, None);
    checks::forces(&code, &structure, &calculated, 2e-2);
}

#[test]
fn too_few_steps_are_not_converged_and_the_next_rung_converges() {
    let few = prepared(EspressoSettings { max_scf_steps: 5, ..settings() });
    let (calculated, failures) = climb(&few, &structures::silicon());
    assert_eq!(failures, [FailureClass::NotConverged]);
    let enough = prepared(settings());
    assert_eq!(few.identity(), enough.identity());
    // No adjustment changes the energy.
    let every = attempt(&enough, &structures::silicon(), &RetryAdjustment::ALL.into()).unwrap();
    for other in [label(&enough, &structures::silicon()), every] {
        assert!((calculated.energy - other.energy).abs() < 1e-5, "{calculated:?} {other:?}");
    }
}

#[test]
fn another_program_and_other_pseudopotentials_are_refused_before_anything_runs() {
    let passed = PassedEnvironment::default();
    let echo = EspressoSettings { command: vec!["echo".into(), "hello".into()], ..settings() };
    let error = echo.prepare(&passed).unwrap_err().to_string();
    assert_eq!(error, "echo hello: is not pw.x: expected 'Program PWSCF v.…', found: hello");
    let none = EspressoSettings { command: vec!["no-such-pw.x".into()], ..settings() };
    assert!(none.prepare(&passed).unwrap_err().to_string().starts_with("no-such-pw.x: does not start ("));
    let lda = BTreeMap::from([("Al".parse().unwrap(), "Al.pz-vbc.UPF".to_owned())]);
    let lda = EspressoSettings { pseudopotential_variants: lda, ..settings() };
    let error = lda.prepare(&passed).unwrap_err().to_string();
    assert!(error.ends_with("Al.pz-vbc.UPF: is for the functional SLA PZ NOGX NOGC, not for PBE"), "{error}");
    // Without names: iron has several, aluminium none for PBE.
    let unnamed = prepared(EspressoSettings { pseudopotential_variants: BTreeMap::new(), ..settings() });
    let fault = |symbol: &str| unnamed.supports(&[symbol.parse().unwrap()].into()).unwrap_err().to_string();
    assert!(
        fault("Fe").contains("has several, Fe.pbe-mt_fhi.UPF, Fe.pbe-nd-rrkjus.UPF, "),
        "{}",
        fault("Fe")
    );
    assert!(fault("Al").contains("not for PBE"), "{}", fault("Al"));
}
