//! Validation of a grade, with and without labels, through the program.

use std::path::Path;

use atoms::extxyz::Frame;
use atoms::read_extxyz;
use serde_json::{Value, json};

use crate::common::npz::with_changed_arrays;
use crate::common::{config, deviation, refuse, succeed, write_frames};

mod mixtures;

fn validate(directory: &Path, model: &str, output: &str, more: &[&str]) -> String {
    let model = config(&format!("data/{model}/kokkos.npz"));
    let start = ["calm", "validate", "--model", model.to_str().unwrap(), "--output", output];
    succeed(directory, start.iter().chain(more))
}

fn read_json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// Builds baselines of the aluminium model from four of its training structures.
fn baselines(here: &Path, arguments: &[&str]) {
    write_frames(&here.join("train.extxyz"), &aluminium(4));
    let model = config("data/al_eam_1l/kokkos.npz");
    let start = ["calm", "baseline", "--model", model.to_str().unwrap(), "train.extxyz", "--output"];
    succeed(here, start.iter().chain(arguments));
}

/// Labelled structures from the training data of the aluminium model.
fn aluminium(number: usize) -> Vec<Frame> {
    let mut frames = read_extxyz(&config("data/al_eam_1l/seed_frames.extxyz")).unwrap();
    frames.truncate(number);
    frames
}

/// Grades a file with the aluminium model into scored.extxyz. Returns the standard output.
fn score(here: &Path, input: &str, arguments: &[&str]) -> String {
    let model = config("data/al_eam_1l/kokkos.npz");
    let start = ["calm", "score", "--model", model.to_str().unwrap(), input, "--output", "scored.extxyz"];
    succeed(here, start.iter().chain(arguments))
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
    let quick = ["--scan-steps", "16", "--no-relax", "--collision-evaluations", "100"];
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
    assert_eq!(names, ["vacancy", "(111)", "(100)", "(110)", "Σ5 (310)", "vacancy", "(111)"]);
    let (own, others) = defects.split_at(5);
    assert!(own.iter().all(|defect| defect["prototype"] == "fcc" && defect["is_ground_state"] == true));
    for defect in others {
        // The bond scan of bcc aluminium has the distance of these crystals, and the grade of the perfect one.
        assert!(defect["prototype"] == "bcc" && defect["relaxation"].is_null(), "{defect}");
        let perfect = &found["bond_scans"][1]["detection"][0]["at_equilibrium"];
        let [crystal, perfect] = [&defect["crystal"][0], perfect].map(|gamma| gamma.as_f64().unwrap());
        assert!((crystal / perfect - 1.0).abs() < 1e-9, "{crystal} {perfect}");
    }
    for defect in own {
        let shells = defect["shells"].as_array().unwrap();
        let grade = |shell: &Value| shell["scores"][0].as_f64().unwrap();
        let (near, far) = (grade(&shells[0]), grade(&shells[shells.len() - 1]));
        assert!(near > far && defect["error"].is_null(), "{defect}");
    }
    assert!(found["solutions"].as_array().unwrap().is_empty());
    let pair = &found["collisions"][0]["features"][0];
    assert!(pair["distance"].as_f64().unwrap() > 1e3 * pair["rounding"].as_f64().unwrap(), "{pair}");
    searches_come_closer(&here.join("first"), &found["matched_pairs"]);
    ranks_are_bounded(&found["feature_ranks"]);

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
    // Both crystals share a panel, the second one dashed.
    for figure in ["bond-scans", "vacancies", "surfaces"] {
        let svg = std::fs::read_to_string(here.join(format!("first/figures/{figure}.svg"))).unwrap();
        assert!(svg.contains(">Al, fcc; dashed, bcc<") && svg.contains("does not form"), "{figure}");
        let dashed = |line: &str| line.contains("#d55e00") && line.contains("stroke-dasharray");
        assert!(svg.lines().any(dashed), "{figure}");
    }
    validate(here, "al_eam_1l", "second", &quick);
    assert!(files == contents(&here.join("second")), "the same bytes");
}

/// The hidden layer is a function of nine densities; all atoms together tell every direction but translations and rotations.
fn ranks_are_bounded(ranks: &Value) {
    let number = |rank: &Value, key: &str| rank[key].as_u64().unwrap();
    let described: Vec<_> = ranks.as_array().unwrap().iter().map(|rank| number(rank, "atoms")).collect();
    assert_eq!(described, [1, 51, 1, 51]);
    for rank in ranks.as_array().unwrap() {
        assert_eq!(rank["directions"], 3 * 51 - 6);
        assert!(rank["smallest"].as_f64() > rank["next"].as_f64(), "{rank}");
        let full = if number(rank, "atoms") == 1 { number(rank, "dimension").min(147) } else { 147 };
        assert!((1..=full).contains(&number(rank, "rank")), "{rank}");
    }
    assert!(number(&ranks[0], "rank") <= 9 && number(&ranks[2], "rank") > 100, "{ranks}");
    assert_eq!([1, 3].map(|k| number(&ranks[k], "rank")), [147; 2]);
}

/// Each search from an allowed start brings the features of both environments closer, and its pair is in the file.
fn searches_come_closer(output: &Path, pairs: &Value) {
    let described: Vec<_> = pairs.as_array().unwrap().iter().map(|pair| &pair["neighbours"]).collect();
    // Nine densities can tell environments of three neighbours apart.
    assert_eq!(described, [50, 50, 3, 50, 50, 50]);
    for pair in pairs.as_array().unwrap() {
        let number = |key: &str| pair[key].as_f64().unwrap();
        let is_closer = number("distance") < number("start_distance");
        assert!(is_closer || pair["start"] != "unrelated", "{pair}");
        assert!(pair["evaluations"].as_u64().unwrap() <= 100 && pair["is_different"].is_boolean(), "{pair}");
    }
    let frames = read_extxyz(&output.join("collisions.extxyz")).unwrap();
    let atoms: Vec<_> = frames.iter().map(|frame| frame.structure.len()).collect();
    assert_eq!(atoms, [51, 51, 51, 51, 4, 4, 51, 51, 51, 51, 51, 51]);
    let table = std::fs::read_to_string(output.join("tables/collision-search.csv")).unwrap();
    assert_eq!(table.lines().count(), 7, "{table}");
    // The walk moves the neighbours, and the hidden layer stays.
    let walk = &pairs[5];
    assert!(walk["start"] == "null_space" && walk["is_different"] == true, "{walk}");
    assert!(
        walk["distance"].as_f64().unwrap() <= 1e-9 && walk["superposed"].as_f64().unwrap() > 0.03,
        "{walk}"
    );
    let [a, b] = [0, 1].map(|k| walk["energies"][k].as_f64().unwrap());
    assert!((a - b).abs() < 1e-7 * a.abs().max(1.0), "{walk}");
}

#[test]
fn solid_solutions_are_scanned_for_models_of_several_elements() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let model = config("data/ni_al_h_eam_1l/kokkos.npz");
    let readout = |name: &str, numbers: &mut Vec<f64>| {
        if name == "energy_mlp_W0" {
            numbers.iter_mut().for_each(|number| *number *= 1.05);
        }
    };
    std::fs::write(here.join("other.npz"), with_changed_arrays(&model, readout)).unwrap();
    let ensemble = ["--ensemble", "other.npz"];
    let only = [
        "--elements",
        "Ni",
        "--scan-steps",
        "4",
        "--no-relax",
        "--collision-evaluations",
        "0",
        "--solution-structures",
        "1",
        "--pairs",
        "Ni-Al",
    ];
    let frames = read_extxyz(&config("data/ni_al_h_eam_1l/seed_frames.extxyz")).unwrap();
    let [labelled, second] = [0, 1].map(|k| frames.iter().skip(k).step_by(9).cloned().collect::<Vec<_>>());
    write_frames(&here.join("labelled.extxyz"), &labelled);
    write_frames(&here.join("second.extxyz"), &second);
    let text = std::fs::read(here.join("labelled.extxyz")).unwrap();
    std::fs::write(here.join("training.extxyz.zst"), zstd::encode_all(&text[..], 3).unwrap()).unwrap();
    let labels = ["--labelled", "labelled.extxyz", "second.extxyz", "--training", "training.extxyz.zst"];
    let labels = [&labels[..], &["--compare-model", "other.npz"]].concat();
    validate(here, "ni_al_h_eam_1l", "out", &[&only[..], &ensemble[..], &labels[..]].concat());
    let found = json(&here.join("out"));
    errors_are_divided(&found["labelled"][0]["report"], &labelled);
    errors_are_divided(&found["labelled"][1]["report"], &second);
    sets_are_beside_each_other(here, &found);
    energies_spread(here, &found);
    training_data_are_counted(&found, &labelled);
    let page = std::fs::read_to_string(here.join("out/validation.html")).unwrap();
    assert!(
        page.contains("id=\"figure-composition-errors\"") && page.contains("id=\"table-element-errors\"")
    );
    let solution = &found["solutions"][0];
    assert_eq!(
        (&solution["elements"], &solution["prototype"]),
        (&serde_json::json!(["Ni", "Al"]), &"fcc".into())
    );
    let compositions = solution["compositions"].as_array().unwrap();
    assert_eq!(compositions.len(), 11);
    // Aluminium atoms are larger than nickel atoms.
    let distance = |k: usize| compositions[k]["distance"].as_f64().unwrap();
    assert!(distance(0) < distance(5) && distance(5) < distance(10), "{solution}");
    let atoms: u64 =
        solution["first_shells"].as_array().unwrap().iter().map(|of| of["atoms"].as_u64().unwrap()).sum();
    assert_eq!(atoms, 11 * 128);
}

/// The spread of the energies at defects is half the distance of those that `calm score` gives with either model.
fn energies_spread(here: &Path, found: &Value) {
    assert_eq!(found["scores"][1]["name"], "energy spread");
    let model = config("data/ni_al_h_eam_1l/kokkos.npz").display().to_string();
    let [own, other] = [model.as_str(), "other.npz"].map(|model| -> Vec<f64> {
        let score = ["calm", "score", "--model", model, "out/structures.extxyz", "--output", "scored.extxyz"];
        succeed(here, score);
        let frames = read_extxyz(&here.join("scored.extxyz")).unwrap();
        frames
            .iter()
            .map(|frame| frame.info["energy"].number().unwrap() / frame.structure.len() as f64)
            .collect()
    });
    let defects = found["defects"].as_array().unwrap().iter().filter(|defect| defect["error"].is_null());
    let spread: Vec<f64> = defects.map(|defect| defect["shells"][0]["scores"][1].as_f64().unwrap()).collect();
    let expected: Vec<f64> = own.iter().zip(&other).map(|(own, other)| 0.5 * (own - other).abs()).collect();
    assert!(expected.len() > 3 && expected.iter().all(|spread| *spread > 1e-5), "{expected:?}");
    assert!(deviation(&spread, &expected) < 1e-6, "{spread:?} {expected:?}");
}

/// Two sets have figures and tables of their own, and common ones.
fn sets_are_beside_each_other(here: &Path, found: &Value) {
    let output = &here.join("out");
    let sets = found["labelled"].as_array().unwrap();
    let files: Vec<_> = sets.iter().map(|set| &set["file"]).collect();
    assert_eq!(files, ["labelled.extxyz", "second.extxyz"]);
    for (set, file) in sets.iter().zip(["labelled.extxyz", "second.extxyz"]) {
        // The other model has its own errors and its own grades.
        let score =
            ["calm", "score", "--model", "other.npz", file, "--output", "scored.extxyz", "--json", "o.json"];
        succeed(here, score);
        let expected = read_json(&here.join("o.json"));
        let other = &set["models"][0];
        assert_eq!((&other["grade"], &other["average"]), (&expected["scores"][0], &expected["scores"][1]));
        assert_ne!(other["average"], set["report"]["scores"][1]);
    }
    for file in ["figures/reliability", "figures/composition-errors", "tables/ranks", "tables/label-errors"] {
        let [first, second] =
            ["", "-2"].map(|set| std::fs::read(output.join(format!("{file}{set}.csv"))).unwrap());
        assert!(first != second, "{file}");
    }
    let rows = std::fs::read_to_string(output.join("tables/labelled-sets.csv")).unwrap();
    let scores = sets[0]["report"]["scores"].as_array().unwrap();
    assert_eq!(rows.lines().count(), 1 + 2 * scores.len(), "{rows}");
    for (set, row) in sets.iter().zip(rows.lines().skip(1)) {
        let rho: f64 = row.split(',').nth(6).unwrap().parse().unwrap();
        assert!((rho - set["report"]["scores"][0]["spearman"]["value"].as_f64().unwrap()).abs() < 1e-12);
    }
    // Two models and two sets.
    let grids = ["error-grid", "error-grid-gamma"].map(|name| {
        let grid = std::fs::read_to_string(output.join(format!("figures/{name}.svg"))).unwrap();
        assert_eq!(grid.matches(": second.extxyz<").count(), 2, "{grid}");
        std::fs::read_to_string(output.join(format!("figures/{name}.csv"))).unwrap()
    });
    assert!(grids[0] != grids[1]);
    let page = std::fs::read_to_string(output.join("validation.html")).unwrap();
    assert!(page.contains("id=\"figure-error-grid\"") && page.contains("id=\"figure-error-grid-gamma\""));
    assert!(page.contains("second.extxyz</h2>") && page.contains("id=\"figure-reliability-2\""));
    assert_eq!(page.matches("<h2>Labelled structures of ").count(), 2);
    assert_eq!(page.matches("id=\"reliability-clip-1\"").count(), 1);
}

/// The training data of the test are its first labelled set.
fn training_data_are_counted(found: &Value, frames: &[Frame]) {
    let training = &found["training"];
    let report = &found["labelled"][0]["report"];
    assert_eq!(training["structures"], frames.len());
    assert_eq!(training["errors"]["energy"], report["energy_without_offsets"]["mean_absolute"]["value"]);
    let force = training["errors"]["force"].as_f64().unwrap();
    // |F| is at least the mean of its three components' sizes, and at most their sum.
    let component = report["forces"]["mean_absolute"]["value"].as_f64().unwrap();
    assert!((1.0..=3.0).contains(&(force / component)), "{force} {component}");
    let is_of_pair = |frame: &&Frame| {
        frame.structure.species.iter().all(|species| ["Ni", "Al"].contains(&species.symbol()))
    };
    let of_pair: Vec<_> = frames.iter().filter(is_of_pair).collect();
    let pair = &training["pairs"][0];
    assert_eq!(pair["structures"], of_pair.len());
    let shells = pair["shells"].as_array().unwrap();
    let atoms: u64 = shells.iter().map(|shell| shell["atoms"].as_u64().unwrap()).sum();
    let all: usize = of_pair.iter().map(|frame| frame.structure.len()).sum();
    assert!(atoms > 0 && atoms as usize <= all, "{pair}");
}

/// Labelled structures and their atoms by composition and by element.
fn errors_are_divided(report: &Value, frames: &[Frame]) {
    let share = |frame: &Frame| {
        let nickel = frame.structure.species.iter().filter(|species| species.symbol() == "Ni").count();
        (10.0 * nickel as f64 / frame.structure.len() as f64).round() / 10.0
    };
    let scans = report["compositions"].as_array().unwrap();
    let scan = scans.iter().find(|scan| scan["element"] == "Ni").unwrap();
    let groups = scan["groups"].as_array().unwrap();
    assert!(groups.len() > 1, "{scan}");
    for group in groups {
        let members: Vec<_> =
            frames.iter().filter(|frame| share(frame) == group["share"].as_f64().unwrap()).collect();
        let atoms: usize = members.iter().map(|frame| frame.structure.len()).sum();
        assert_eq!((&group["structures"], &group["atoms"]), (&members.len().into(), &atoms.into()));
        assert!(group["energy"]["mean"].is_f64() && group["forces"]["mean"].is_f64(), "{group}");
    }
    let elements = report["elements"].as_array().unwrap();
    let atoms: u64 = elements.iter().map(|of| of["atoms"].as_u64().unwrap()).sum();
    assert_eq!((elements.len(), json!(atoms)), (3, report["atoms"].clone()));
}

#[test]
fn labelled_structures_have_a_section() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    baselines(here, &["b.npz", "--kind", "llpr"]);
    // One that cannot be graded is left out.
    let mut frames = aluminium(4);
    frames[1].structure.positions[1] = frames[1].structure.positions[0];
    write_frames(&here.join("labelled.extxyz"), &frames);
    let printed =
        score(here, "labelled.extxyz", &["--baseline", "b.npz", "--json", "l.json", "--figures", "drawn"]);
    let quick = ["--scan-steps", "2", "--no-relax", "--collision-evaluations", "0"];
    let more = [&["--labelled", "labelled.extxyz", "--baseline", "b.npz"][..], &quick].concat();
    let text = validate(here, "al_eam_1l", "out", &more);
    // The section equals the output of `calm score`.
    let (_, tables) = printed.split_once("\n\n").unwrap();
    assert!(tables.contains("Spearman’s ρ") && text.contains(tables), "{text}\n{tables}");
    let found = json(&here.join("out"));
    assert_eq!(found["labelled"][0]["report"], read_json(&here.join("l.json")));
    let report = &found["labelled"][0]["report"];
    let names: Vec<_> =
        report["scores"].as_array().unwrap().iter().map(|score| score["name"].clone()).collect();
    assert_eq!(json!(names), json!(["γ", "γ_{nbr}", "llpr", "llpr-nbr"]));
    let same = |file: &str, kind: &str| {
        let of_validation = std::fs::read(here.join("out").join(kind).join(file)).unwrap();
        assert!(of_validation == std::fs::read(here.join("drawn").join(file)).unwrap(), "{file}");
    };
    for table in ["label-errors.csv", "ranks.csv", "confident.csv", "auc-thresholds.csv", "quantiles.csv"] {
        same(table, "tables");
    }
    for figure in ["reliability.svg", "error-histograms.csv", "contamination.csv", "auc-sweep.png"] {
        same(figure, "figures");
    }
    let rho = report["scores"][0]["spearman"]["value"].as_f64().unwrap();
    let page = std::fs::read_to_string(here.join("out/validation.html")).unwrap();
    assert!(page.contains("<h2>Labelled structures</h2>") && page.contains("id=\"table-ranks\""));
    assert!(page.contains("id=\"table-auc-thresholds\"") && page.contains("id=\"figure-error-histograms\""));
    assert!(
        page.contains(&format!("In 3 labelled structures, Spearman’s ρ of γ and force error is {rho:.3}."))
    );

    // Refuses structures without labels, and an output that would replace the input.
    let model = config("data/al_eam_1l/kokkos.npz");
    let refused = |output: &str, labelled: &str| {
        let start = ["calm", "validate", "--model", model.to_str().unwrap(), "--output", output];
        refuse(here, start.into_iter().chain(["--labelled", labelled]))
    };
    write_frames(&here.join("bare.extxyz"), &[Frame::from(aluminium(1).remove(0).structure)]);
    assert!(refused("new", "bare.extxyz").contains("bare.extxyz: no structure has a label"));
    for file in ["out/structures.extxyz", "out/collisions.extxyz"] {
        assert!(refused("out", file).contains("is a file of labelled structures"));
    }
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
    assert!(refused(&["--output", "file"]).contains("file is not a directory"));
    assert!(!here.join("out").exists());
    assert_eq!(std::fs::read_to_string(here.join("file")).unwrap(), "kept");
}
