use analysis::{EnergyOffsets, LabelledEnergy};
use atoms::Cell;

use super::*;

fn silicon(atoms: usize) -> Structure {
    Structure {
        species: vec!["Si".parse().unwrap(); atoms],
        positions: (0..atoms).map(|k| [2.4 * k as f64, 0.0, 0.0]).collect(),
        cell: Cell::orthorhombic(20.0, 20.0, 20.0),
        periodic: [true; 3],
    }
}

fn good() -> CalculationResults {
    CalculationResults {
        energy: -215.0,
        forces: vec![[0.5, 0.0, 0.0]; 2],
        stress: Some([[0.1; 3]; 3]),
        magnetic_moments: Some(vec![1.0; 2]),
        ..CalculationResults::default()
    }
}

/// Offsets fitted to `good` labels of Si₂, whose energies are 103 eV/atom below the potential's, and to bad ones.
fn offsets(good: usize, bad: &[f64]) -> EnergyOffsets {
    let energies = (0..good).map(|k| -206.0 + 0.01 * k as f64).chain(bad.iter().copied());
    let label = |label| LabelledEnergy { composition: vec![(14, 2)], model: -9.0, label: label - 9.0 };
    EnergyOffsets::fit(&energies.map(label).collect::<Vec<_>>()).unwrap()
}

/// The message about a result with this change; empty if it is valid.
fn said(change: impl FnOnce(&mut CalculationResults), offsets: Option<&EnergyOffsets>) -> String {
    let mut made = good();
    change(&mut made);
    let expected = offsets.map(|offsets| EnergyReference { model: -9.0, offsets });
    match validate(made, &silicon(2), &LabelBounds::default(), expected) {
        Ok(_) => String::new(),
        Err(failure) => {
            assert_eq!(failure.class, FailureClass::Implausible);
            failure.message
        }
    }
}

#[test]
fn non_finite_numbers_and_wrong_counts_are_rejected() {
    assert_eq!(said(|_| (), None), "");
    for energy in [f64::NAN, f64::INFINITY] {
        let expected = format!("an energy of {energy}, which is not a finite number");
        assert_eq!(said(|made| made.energy = energy, None), expected);
        assert_eq!(said(|made| made.energy_without_smearing = Some(energy), None), expected);
    }
    let nan = "of NaN, which is not a finite number";
    assert_eq!(said(|made| made.forces[1][2] = f64::NAN, None), format!("a force {nan}"));
    assert_eq!(
        said(|made| made.stress = Some([[f64::NAN; 3]; 3]), None),
        format!("a stress component {nan}")
    );
    assert_eq!(said(|made| made.magnetisation = Some(f64::NAN), None), format!("a magnetic moment {nan}"));
    assert_eq!(said(|made| made.forces = vec![[0.0; 3]], None), "1 forces for 2 atoms");
    assert_eq!(said(|made| made.magnetic_moments = Some(vec![]), None), "0 magnetic moments for 2 atoms");
}

#[test]
fn results_out_of_bounds_are_rejected() {
    for energy in [1e300, -1e300] {
        let expected = format!(
            "an energy of {:.3e} eV/atom, beyond label.max_energy_per_atom = 2000000 eV/atom",
            energy / 2.0
        );
        assert_eq!(said(|made| made.energy = energy, None), expected);
        assert_eq!(said(|made| made.energy_without_smearing = Some(energy), None), expected);
    }
    // Uranium with all its electrons.
    assert_eq!(said(|made| made.energy = -2.0 * 7.6e5, None), "");
    let stress = said(|made| made.stress.as_mut().unwrap()[1][2] = -15.5, None);
    assert_eq!(
        stress,
        "a stress component of -15.5 eV/Å³ (-2483.37 GPa), beyond label.max_stress = 10 eV/Å³"
    );
    let force = said(|made| made.forces[1] = [0.0, -1200.0, 1600.0], None);
    assert_eq!(force, "a force of 2000 eV/Å, beyond label.max_force = 1000 eV/Å");
}

#[test]
fn an_energy_is_compared_once_enough_labels_support_it() {
    let far = |made: &mut CalculationResults| made.energy = -215.0 + 2.0 * 5e4;
    assert_eq!(said(far, None), "");
    assert_eq!(said(far, Some(&offsets(4, &[]))), "", "four labels");
    let fitted = offsets(5, &[]);
    assert_eq!(said(|_| (), Some(&fitted)), "");
    let message = said(far, Some(&fitted));
    assert!(
        message.starts_with("an energy that differs by 49999.99 eV/atom from the potential's"),
        "{message}"
    );
    let end = "from 5 labels, taken out), beyond label.max_energy_difference_per_atom = 100 eV/atom";
    assert!(message.ends_with(end), "{message}");
    // Bad labels that were accepted do not move the offsets.
    let spoilt = offsets(5, &[1e5, -1e300]);
    assert_eq!(said(|_| (), Some(&spoilt)), "");
    assert!(said(far, Some(&spoilt)).contains("from 5 labels"));
    // Another element: nothing is known.
    let mut mixed = silicon(2);
    mixed.species[1] = "Ge".parse().unwrap();
    let expected = EnergyReference { model: -9.0, offsets: &fitted };
    let mut made = good();
    far(&mut made);
    assert!(validate(made, &mixed, &LabelBounds::default(), Some(expected)).is_ok());
}
