//! Tests of a grade without labels, through the program.

use std::path::Path;

use serde_json::Value;

use crate::common::{config, refuse, succeed};

fn validate(directory: &Path, model: &str, output: &str, more: &[&str]) -> String {
    let model = config(&format!("data/{model}/kokkos.npz"));
    let start = ["calm", "validate", "--model", model.to_str().unwrap(), "--output", output];
    succeed(directory, start.iter().chain(more))
}

fn json(directory: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(directory.join("validation.json")).unwrap()).unwrap()
}

/// All files below a directory with their contents.
fn contents(directory: &Path) -> Vec<(String, Vec<u8>)> {
    let mut open = vec![directory.to_owned()];
    let mut found = Vec::new();
    while let Some(path) = open.pop() {
        if path.is_dir() {
            open.extend(std::fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().path()));
        } else {
            let name = path.strip_prefix(directory).unwrap().display().to_string();
            found.push((name, std::fs::read(&path).unwrap()));
        }
    }
    found.sort();
    found
}

#[test]
fn a_model_of_one_element_is_tested_completely() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let quick = ["--scan-steps", "16", "--no-relax"];
    let text = validate(here, "al_eam_1l", "first", &quick);
    assert!(text.contains("Al") && text.contains("yes/yes") && text.contains("fcc (111)"), "{text}");
    let found = json(&here.join("first"));
    let scan = &found["bond_scans"][0];
    assert_eq!(
        (&scan["element"], &scan["prototype"], &scan["is_own"]),
        (&"Al".into(), &"fcc".into(), &true.into())
    );
    // The lattice constant of the potential that the model was trained on is 4.05 Å.
    let equilibrium = scan["equilibrium"].as_f64().unwrap();
    assert!((equilibrium - 4.05 / 2.0_f64.sqrt()).abs() < 0.03, "{equilibrium}");
    let points = scan["points"].as_array().unwrap();
    assert_eq!(
        (points.len(), points[0]["distance"].as_f64(), points[15]["distance"].as_f64()),
        (16, Some(1.5), Some(6.0))
    );
    let detection = &found["scores"][0]["detection"];
    assert_eq!((&detection["compression"], &detection["stretching"]), (&true.into(), &true.into()));
    let defects = found["defects"].as_array().unwrap();
    let names: Vec<_> = defects.iter().map(|defect| defect["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["vacancy", "(111)", "(100)", "(110)", "Σ5 (310)"]);
    for defect in defects {
        let shells = defect["shells"].as_array().unwrap();
        let grade = |shell: &Value| shell["scores"][0].as_f64().unwrap();
        let (near, far) = (grade(&shells[0]), grade(&shells[shells.len() - 1]));
        assert!(near > far && defect["error"].is_null(), "{defect}");
    }
    assert!(found["solutions"].as_array().unwrap().is_empty());
    let pair = &found["collisions"][0]["features"][0];
    assert!(pair["distance"].as_f64().unwrap() > 1e3 * pair["rounding"].as_f64().unwrap(), "{pair}");

    let files = contents(&here.join("first"));
    let names: Vec<_> = files.iter().map(|(name, _)| name.as_str()).collect();
    for name in [
        "validation.html",
        "structures.extxyz",
        "figures/bond-scans.png",
        "figures/surfaces.svg",
        "tables/defects.csv",
    ] {
        assert!(names.contains(&name), "{name}: {names:?}");
    }
    let page = &files.iter().find(|(name, _)| name == "validation.html").unwrap().1;
    let page = std::str::from_utf8(page).unwrap();
    assert!(
        page.contains("Table 1.") && page.contains("no two elements") && page.matches("<svg").count() == 5
    );
    validate(here, "al_eam_1l", "second", &quick);
    assert!(files == contents(&here.join("second")), "the same bytes");
}

#[test]
fn solid_solutions_are_scanned_for_models_of_several_elements() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let model = config("data/ni_al_h_eam_1l/kokkos.npz");
    let ensemble = ["--ensemble", model.to_str().unwrap()];
    let only = [
        "--elements",
        "Ni",
        "--scan-steps",
        "4",
        "--no-relax",
        "--solution-structures",
        "1",
        "--pairs",
        "Ni-Al",
    ];
    validate(here, "ni_al_h_eam_1l", "out", &[&only[..], &ensemble[..]].concat());
    let found = json(&here.join("out"));
    // A model agrees with itself everywhere.
    let spread = &found["scores"][1];
    assert_eq!(
        (&spread["name"], &spread["detection"]["at_equilibrium"]),
        (&"energy spread".into(), &0.0.into())
    );
    assert_eq!(spread["detection"]["compression"], Value::Bool(false));
    let solution = &found["solutions"][0];
    assert_eq!(
        (&solution["elements"], &solution["prototype"]),
        (&serde_json::json!(["Ni", "Al"]), &"fcc".into())
    );
    let compositions = solution["compositions"].as_array().unwrap();
    assert_eq!(compositions.len(), 11);
    // Aluminium atoms are larger.
    let distance = |k: usize| compositions[k]["distance"].as_f64().unwrap();
    assert!(distance(0) < distance(5) && distance(5) < distance(10), "{solution}");
    let atoms: u64 =
        solution["first_shells"].as_array().unwrap().iter().map(|of| of["atoms"].as_u64().unwrap()).sum();
    assert_eq!(atoms, 11 * 128);
}

#[test]
fn wrong_arguments_are_named() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    std::fs::write(here.join("file"), "kept").unwrap();
    let model = config("data/al_eam_1l/kokkos.npz");
    let refused = |more: &[&str]| {
        let start = ["calm", "validate", "--model", model.to_str().unwrap()];
        refuse(here, start.iter().chain(more))
    };
    assert!(
        refused(&["--output", "out", "--elements", "Cu"])
            .contains("does not support Cu; expected some of Al")
    );
    assert!(refused(&["--output", "out", "--pairs", "Al-Al"]).contains("two different elements"));
    assert!(refused(&["--output", "out", "--scan-steps", "1"]).contains("at least 2"));
    let silicon = config("data/si_sw_1l/kokkos.npz");
    let silicon = silicon.to_str().unwrap();
    assert!(refused(&["--output", "out", "--ensemble", silicon]).contains("does not support Al"));
    assert!(refused(&["--output", "file"]).contains("file is no directory"));
    assert!(!here.join("out").exists());
    assert_eq!(std::fs::read_to_string(here.join("file")).unwrap(), "kept");
}
