//! Tests that do not need GPAW: the input, and the parsing of a stored result (`tests/data/gpaw`).

use std::collections::BTreeSet;

use super::*;
use crate::{FailureClass, PinnedFile};

const RESULT: &[u8] = include_bytes!("../../tests/data/gpaw/result.json");

/// The structure of `RESULT`.
fn silicon() -> Structure {
    let task: Value = serde_json::from_slice(include_bytes!("../../tests/data/gpaw/input.json")).unwrap();
    let take = |key: &str| task[key].clone();
    Structure {
        species: serde_json::from_value(take("species")).unwrap(),
        positions: serde_json::from_value(take("positions")).unwrap(),
        cell: atoms::Cell(serde_json::from_value(take("cell")).unwrap()),
        periodic: [true; 3],
    }
}

fn gpaw(settings: GpawSettings) -> Gpaw {
    let versions =
        GpawVersions { gpaw: "22.8.0".into(), ase: "3.22.1".into(), setup_paths: vec!["/setups".into()] };
    let setup = Setup { pinned: PinnedFile::fake("/setups/Si.PBE", "abc"), valence: 4.0 };
    let setups = BTreeMap::from([("Si".parse().unwrap(), setup)]);
    Gpaw { environment: settings.environment(), settings, versions, setups }
}

fn task(code: &Gpaw, adjustments: &[RetryAdjustment]) -> Value {
    let input = code.input(&silicon(), &BTreeSet::from_iter(adjustments.iter().copied())).unwrap();
    serde_json::from_slice(&input.files["input.json"]).unwrap()
}

/// A directory with GPAW's result.
fn left(result: &[u8]) -> tempfile::TempDir {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("result.json"), result).unwrap();
    directory
}

fn read(structure: &Structure, result: &[u8]) -> Result<CalculationResults, Failure> {
    gpaw(GpawSettings::default()).read(structure, left(result).path(), Exit::Code(0))
}

fn by(gpaw: &str) -> Value {
    json!({ "gpaw": gpaw, "ase": "3.22.1" })
}

#[test]
fn the_protocol_of_the_paper_is_written() {
    let code = gpaw(GpawSettings::default());
    let input = code.input(&silicon(), &BTreeSet::new()).unwrap();
    assert_eq!(input, code.input(&silicon(), &BTreeSet::new()).unwrap());
    assert_eq!(input.command, ["/usr/bin/python3", "job.py"]);
    assert_eq!(input.environment["OMP_NUM_THREADS"], "1");
    let task = task(&code, &[]);
    assert_eq!(task["cutoff"], json!(500.0));
    assert_eq!(task["moments"], json!([1.0, 1.0]));
    let parameters = &task["parameters"];
    assert_eq!(parameters["occupations"], json!({ "name": "methfessel-paxton", "order": 0, "width": 0.1 }));
    assert_eq!(parameters["kpts"], json!({ "size": [17, 16, 17], "gamma": true }));
    assert_eq!(parameters["convergence"]["energy"], json!(1e-6 / 8.0));
}

#[test]
fn adjustments_change_nothing_that_the_accuracy_depends_on() {
    let code = gpaw(GpawSettings::default());
    let (plain, mut changed) = (task(&code, &[]), task(&code, &RetryAdjustment::ALL));
    assert_ne!(plain, changed);
    assert_eq!(changed["moments"], json!([0.5, 0.5]));
    changed["moments"] = plain["moments"].clone();
    let parameters = changed["parameters"].as_object_mut().unwrap();
    assert_eq!(parameters.insert("maxiter".into(), json!(200)), Some(json!(600)));
    assert!(parameters.remove("mixer").is_some());
    assert!(parameters.remove("eigensolver").is_some());
    assert_eq!(changed, plain);
}

#[test]
fn calculations_read_copies_of_what_was_hashed() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("Si.mine.PBE");
    let before =
        "<atom symbol=\"Si\" valence=\"4\"/>\n<xc_functional type=\"GGA\" name=\"PBE\"/>\n<!-- 1 -->";
    std::fs::write(&file, before).unwrap();
    let pseudopotential_variants = BTreeMap::from([("Si".parse().unwrap(), "mine".to_owned())]);
    let setups = setups::find(&[directory.path().to_owned()], &pseudopotential_variants).unwrap();
    let code = Gpaw { setups, ..gpaw(GpawSettings { pseudopotential_variants, ..GpawSettings::default() }) };
    assert_eq!(task(&code, &[])["setups"], json!("../data"));
    let data = code.input(&silicon(), &BTreeSet::new()).unwrap().data;
    // Under the name that GPAW looks for.
    assert_eq!(data.keys().collect::<Vec<_>>(), ["Si.mine.PBE"]);
    let hash = blake3::hash(before.as_bytes()).to_hex().to_string();
    assert_eq!(code.identity()["pseudopotentials"], json!({ "Si": hash }));
    assert_eq!(data["Si.mine.PBE"].content().unwrap(), before.as_bytes());
    std::fs::write(&file, before.replace('1', "2")).unwrap();
    assert!(data["Si.mine.PBE"].content().is_err());
}

#[test]
fn what_changes_a_value_is_in_the_identity_and_nothing_else() {
    let identity = |settings: GpawSettings| gpaw(settings).identity();
    let plain = identity(GpawSettings::default());
    assert_eq!(plain["pseudopotentials"], json!({ "Si": "abc" }));
    let slower = GpawSettings { max_scf_steps: 7, command: vec!["mpirun".into()], ..GpawSettings::default() };
    assert_eq!(identity(slower), plain);
    assert_ne!(identity(GpawSettings { cutoff: 400.0, ..GpawSettings::default() }), plain);
    assert_ne!(identity(GpawSettings { spin_polarized: false, ..GpawSettings::default() }), plain);
}

#[test]
fn a_result_is_a_label() {
    let label = read(&silicon(), RESULT).unwrap();
    assert_eq!(label.energy, -8.194105770234588);
    assert!(label.energy_without_smearing.unwrap() >= label.energy);
    assert_eq!(label.forces.len(), 2);
    assert_eq!(label.magnetic_moments.unwrap().len(), 2);
    assert!(label.electronic_steps.unwrap() > 5);
    let stress = label.stress.unwrap();
    let voigt: Value = serde_json::from_slice::<Value>(RESULT).unwrap()["converged"]["stress"].clone();
    assert_eq!(
        json!([stress[0][0], stress[1][1], stress[2][2], stress[1][2], stress[0][2], stress[0][1]]),
        voigt
    );
}

#[test]
fn a_result_that_is_cut_off_is_never_a_label() {
    for end in 0..RESULT.len() {
        let failure = read(&silicon(), &RESULT[..end]).unwrap_err();
        assert_eq!(failure.class, FailureClass::Crashed, "cut at {end}: {failure}");
    }
    let nothing = tempfile::tempdir().unwrap();
    let code = gpaw(GpawSettings::default());
    let failure = code.read(&silicon(), nothing.path(), Exit::TimeLimit).unwrap_err();
    assert_eq!(failure.class, FailureClass::TimeLimit);
}

#[test]
fn a_result_of_another_structure_is_implausible() {
    let mut moved = silicon();
    moved.positions[1][0] += 1e-4;
    assert_eq!(read(&moved, RESULT).unwrap_err().class, FailureClass::Implausible);
    let mut more = silicon();
    more.species.push("Si".parse().unwrap());
    more.positions.push([0.0, 2.0, 2.0]);
    assert_eq!(read(&more, RESULT).unwrap_err().class, FailureClass::Implausible);
}

#[test]
fn failures_that_the_script_tells_keep_their_class() {
    for class in ["not_converged", "bad_input", "out_of_memory", "implausible"] {
        let told = json!({ "failure": { "class": class, "message": "why" }, "by": by("22.8.0") });
        let failure = read(&silicon(), told.to_string().as_bytes()).unwrap_err();
        assert_eq!((failure.class.name(), failure.message.as_str()), (class, "why"));
    }
}

#[test]
fn a_result_of_another_version_is_of_another_program() {
    let with = |by: Value| {
        let mut result: Value = serde_json::from_slice(RESULT).unwrap();
        result["by"] = by;
        read(&silicon(), result.to_string().as_bytes())
    };
    assert!(with(by("22.8.0")).is_ok());
    let failure = with(by("23.9.1")).unwrap_err();
    let expected = "another program: calculated by gpaw 23.9.1, but the protocol requires 22.8.0";
    assert_eq!((failure.class, failure.to_string().as_str()), (FailureClass::OtherProgram, expected));
    assert_eq!(with(json!({ "gpaw": "22.8.0" })).unwrap_err().class, FailureClass::OtherProgram);
    let told = json!({ "failure": { "class": "not_converged", "message": "why" }, "by": by("23.9.1") });
    let failure = read(&silicon(), told.to_string().as_bytes()).unwrap_err();
    assert_eq!(failure.class, FailureClass::OtherProgram);
}

#[test]
fn elements_without_a_setup_are_refused_by_name() {
    let code = gpaw(GpawSettings::default());
    assert_eq!(code.supports(&BTreeSet::from(["Si".parse().unwrap()])), Ok(()));
    let error = code.supports(&BTreeSet::from(["U".parse().unwrap()])).unwrap_err().to_string();
    assert!(error.starts_with("pseudopotential of U: no setup U.PBE (or .gz) in /setups"), "{error}");
    let magnetic = GpawSettings {
        initial_magnetic_moments: BTreeMap::from([("Si".parse().unwrap(), 5.0)]),
        ..GpawSettings::default()
    };
    let error = gpaw(magnetic).supports(&BTreeSet::from(["Si".parse().unwrap()])).unwrap_err().to_string();
    assert_eq!(error, "initial_magnetic_moments: found Si = 5, expected at most its 4 valence electrons");
}
