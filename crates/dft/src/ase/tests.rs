//! Tests that do not need Python: the input, and the parsing of a result. Tests with Python:
//! `tests/codes/ase.rs`.

use atoms::Cell;

use super::*;

fn copper() -> Structure {
    Structure {
        species: ["Cu", "O"].map(|symbol| symbol.parse().unwrap()).to_vec(),
        positions: vec![[0.1, 0.2, 0.3], [1.0 / 3.0, 2.0, 9.0]],
        cell: Cell([[4.0, 0.0, 0.0], [0.5, 4.0, 0.0], [0.0; 3]]),
        periodic: [true, true, false],
    }
}

fn ase(moments: InitialMagneticMoments) -> Ase {
    let versions = AseVersions { ase: "3.22.1".into(), version: "mine".into() };
    let settings = AseSettings { initial_magnetic_moments: moments, ..AseSettings::default() };
    Ase { environment: BTreeMap::new(), settings, calculator: b"def calculator(): ...".to_vec(), versions }
}

fn task(code: &Ase, adjustments: &[RetryAdjustment]) -> Value {
    let input = code.input(&copper(), &BTreeSet::from_iter(adjustments.iter().copied())).unwrap();
    assert_eq!(input.command, ["python3", "job.py"]);
    assert_eq!(input.files["calculator.py"], b"def calculator(): ...");
    serde_json::from_slice(&input.files["input.json"]).unwrap()
}

#[test]
fn the_task_is_the_structure_with_its_moments_and_adjustments() {
    let plain = json!({
        "species": ["Cu", "O"],
        "positions": [[0.1, 0.2, 0.3], [1.0 / 3.0, 2.0, 9.0]],
        "cell": [[4.0, 0.0, 0.0], [0.5, 4.0, 0.0], [0.0, 0.0, 0.0]],
        "periodic": [true, true, false],
        "moments": null,
        "retry_adjustments": [],
    });
    assert_eq!(task(&ase(InitialMagneticMoments::new()), &[]), plain);
    let changed = task(
        &ase([("Cu".parse().unwrap(), 3.0)].into()),
        &[RetryAdjustment::SlowerMixing, RetryAdjustment::OtherMoments],
    );
    assert_eq!(changed["moments"], json!([1.5, 0.5]));
    assert_eq!(changed["retry_adjustments"], json!(["slower_mixing", "other_moments"]));
}

/// Reads this result for the structure [`copper`].
fn read(mut converged: Value) -> Result<CalculationResults, Failure> {
    let structure = task(&ase(InitialMagneticMoments::new()), &[]);
    for key in ["species", "positions", "cell"] {
        converged[key] = structure[key].clone();
    }
    let directory = tempfile::tempdir().unwrap();
    let by = json!({ "ase": "3.22.1", "version": "mine" });
    let text = json!({ "converged": converged, "by": by }).to_string();
    std::fs::write(directory.path().join("result.json"), text).unwrap();
    ase(InitialMagneticMoments::new()).read(&copper(), directory.path(), Exit::Code(0))
}

#[test]
fn a_calculator_need_not_give_more_than_energy_and_forces() {
    let forces = [[0.1, -0.2, 0.3], [-0.1, 0.2, -0.3]];
    let least = json!({
        "energy": -1.5, "energy_without_smearing": null, "forces": forces, "stress": null, "moments": null,
        "magnetisation": null, "steps": null,
    });
    let expected =
        CalculationResults { energy: -1.5, forces: forces.to_vec(), ..CalculationResults::default() };
    assert_eq!(read(least.clone()), Ok(expected));
    for (key, value) in
        [("energy", json!(null)), ("forces", json!([[0.1, -0.2, 0.3]])), ("stress", json!([1.0]))]
    {
        let mut wrong = least.clone();
        wrong[key] = value;
        assert!(read(wrong).is_err(), "{key}");
    }
}

#[test]
fn a_setting_that_does_not_exist_is_refused() {
    let text = r#"{ "calculator": "a.py", "calculators": "b.py" }"#;
    assert!(serde_json::from_str::<AseSettings>(text).is_err());
    let missing = AseSettings { calculator: "/no/such/file.py".into(), ..AseSettings::default() };
    assert!(matches!(
        missing.prepare(&PassedEnvironment::default()),
        Err(SetupError::Setting { key: "calculator", .. })
    ));
}
