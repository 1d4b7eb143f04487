//! Baselines and further mixtures beside the grade.

use std::path::Path;

use atoms::extxyz::Frame;
use atoms::prototypes::Prototype;
use atoms::read_extxyz;
use serde_json::Value;

use super::{aluminium, baselines, json, score, validate};
use crate::common::{config, deviation, refuse, succeed, write_frames};

/// Builds a mixture over other features of the aluminium model from four of its training structures.
fn mixture_of(here: &Path, variant: &str, output: &str) {
    write_frames(&here.join("train.extxyz"), &aluminium(4));
    let model = config("data/al_eam_1l/kokkos.npz");
    let build = ["calm", "build", "--model", model.to_str().unwrap(), "train.extxyz", "--output", output];
    succeed(here, build.iter().chain(&["--feature-variant", variant, "--candidates", "1"]));
}
#[test]
fn baselines_are_scanned_beside_the_grade() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let artifact = config("data/al_eam_1l/gmm_artifacts.npz");
    let kinds = "d-optimality-element,euclidean,likelihood";
    baselines(here, &["b.npz", "--artifact", artifact.to_str().unwrap(), "--kind", kinds]);
    let linear = ["--feature-variant", "linear", "--kind", "llpr", "--regularisation", "1e-6"];
    baselines(here, &[&["l.npz"], &linear[..]].concat());
    let files = ["--baseline", "b.npz", "--baseline", "l.npz"];
    let quick = ["--scan-steps", "11", "--no-relax", "--collision-evaluations", "0"];
    let text = validate(here, "al_eam_1l", "out", &[&quick[..], &files[..]].concat());
    let found = json(&here.join("out"));
    let scores = found["scores"].as_array().unwrap();
    let described: Vec<_> = scores.iter().map(|score| json!([score["name"], score["rule"]])).collect();
    let expected = json!([
        ["γ", {"threshold": 1.0}],
        ["d-optimality-element", {"threshold": 1.0}],
        ["euclidean", {"times_median": 10.0}],
        ["likelihood", null],
        ["linear-llpr", {"times_median": 10.0}],
    ]);
    assert_eq!(Value::from(described), expected);

    // `calm score` gives the same grades for the same crystals.
    let scan = &found["bond_scans"][0];
    let points = scan["points"].as_array().unwrap();
    let graded: Vec<_> = points.iter().filter(|point| !point["energy"].is_null()).collect();
    assert!(graded.len() > 8, "{scan}");
    let crystal = |point: &&Value| {
        Frame::from(Prototype::Fcc.structure("Al".parse().unwrap(), point["distance"].as_f64().unwrap()))
    };
    write_frames(&here.join("in.extxyz"), &graded.iter().map(crystal).collect::<Vec<_>>());
    score(here, "in.extxyz", &files);
    let scored = read_extxyz(&here.join("scored.extxyz")).unwrap();
    let columns = ["gamma", "d_optimality_element", "euclidean", "likelihood", "linear_llpr"];
    for (k, column) in columns.into_iter().enumerate() {
        let largest = |frame: &Frame| {
            frame.arrays[column].reals().unwrap().into_iter().fold(f64::NEG_INFINITY, f64::max)
        };
        let expected: Vec<_> = scored.iter().map(largest).collect();
        let scanned: Vec<_> = graded.iter().map(|point| point["scores"][k].as_f64().unwrap()).collect();
        assert!(deviation(&scanned, &expected) < 1e-6, "{column}: {scanned:?} {expected:?}");
    }

    // Each score has its own detection rule.
    let equilibrium = scan["equilibrium"].as_f64().unwrap();
    let largest = |k: usize| {
        let compressed =
            points.iter().filter(|point| point["distance"].as_f64().unwrap() < 0.8 * equilibrium);
        compressed.filter_map(|point| point["scores"][k].as_f64()).fold(f64::NEG_INFINITY, f64::max)
    };
    let detection = |k: usize| &scan["detection"][k];
    assert_eq!(detection(1)["compression"], json!(largest(1) > 1.0));
    let median = detection(2)["median_near_equilibrium"].as_f64().unwrap();
    assert_eq!(detection(2)["compression"], json!(largest(2) > 10.0 * median));
    assert_eq!(detection(3)["compression"], Value::Null);
    assert!(text.contains("d-optimality-element") && text.contains("linear-llpr"), "{text}");
    let table = std::fs::read_to_string(here.join("out/tables/detection.csv")).unwrap();
    assert!(table.contains("\neuclidean,above 10 × median at equilibrium,"), "{table}");
    let page = std::fs::read_to_string(here.join("out/validation.html")).unwrap();
    assert!(page.contains("Not drawn, as it has no zero: likelihood."));
}

/// The normalised and the linear features side by side (paper, Table 1).
#[test]
fn further_mixtures_are_scanned_beside_the_grade() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    mixture_of(here, "linear", "linear.npz");
    let own = config("data/al_eam_1l/gmm_artifacts.npz").display().to_string();
    mixture_of(here, "hidden", "hidden.npz");
    let others = ["linear.npz", &own, "hidden.npz"].map(|file| ["--compare-artifact", file]).concat();
    let quick = ["--scan-steps", "4", "--no-relax", "--collision-evaluations", "0"];
    let text = validate(here, "al_eam_1l", "out", &[&quick[..], &others[..]].concat());
    assert!(text.contains("γ (linear)"), "{text}");
    let found = json(&here.join("out"));
    let scores = found["scores"].as_array().unwrap();
    let described: Vec<_> = scores.iter().map(|score| json!([score["name"], score["rule"]])).collect();
    let expected =
        ["γ", "γ (linear)", "γ (gmm_artifacts)", "γ (hidden)"].map(|name| json!([name, {"threshold": 1.0}]));
    assert_eq!(described, expected);
    assert_eq!(scores[2]["detection"], scores[0]["detection"]);
    assert_eq!(found["labelled"], json!([]));

    // `calm score` gives the same grades for the same crystals.
    let scan = &found["bond_scans"][0];
    let points = scan["points"].as_array().unwrap();
    let graded: Vec<_> = points.iter().filter(|point| !point["energy"].is_null()).collect();
    let crystal = |point: &&Value| {
        Frame::from(Prototype::Fcc.structure("Al".parse().unwrap(), point["distance"].as_f64().unwrap()))
    };
    write_frames(&here.join("in.extxyz"), &graded.iter().map(crystal).collect::<Vec<_>>());
    for (artifact, k) in [("linear.npz", 1), ("hidden.npz", 3)] {
        score(here, "in.extxyz", &["--artifact", artifact]);
        let scored = read_extxyz(&here.join("scored.extxyz")).unwrap();
        let largest = |frame: &Frame| {
            frame.arrays["gamma"].reals().unwrap().into_iter().fold(f64::NEG_INFINITY, f64::max)
        };
        let expected: Vec<_> = scored.iter().map(largest).collect();
        let scanned: Vec<_> = graded.iter().map(|point| point["scores"][k].as_f64().unwrap()).collect();
        assert!(graded.len() > 1 && deviation(&scanned, &expected) < 1e-6, "{scanned:?} {expected:?}");
    }
    // A mixture of the hidden layer grades its own data, and is none of the model’s own features.
    score(here, "train.extxyz", &["--artifact", "hidden.npz"]);
    let gamma: Vec<_> = read_extxyz(&here.join("scored.extxyz")).unwrap();
    let gamma: Vec<_> = gamma.iter().flat_map(|frame| frame.arrays["gamma"].reals().unwrap()).collect();
    let above = gamma.iter().filter(|gamma| **gamma > 1.0).count();
    assert!(!gamma.is_empty() && above < gamma.len() / 10, "{above} of {}", gamma.len());
    let model = config("data/al_eam_1l/kokkos.npz").display().to_string();
    let start = ["calm", "validate", "--model", &model, "--output", "x", "--artifact", "hidden.npz"];
    assert!(refuse(here, start).contains("hidden.npz: grades the hidden layer"));
    // Two files of one name are told apart by their directories.
    std::fs::create_dir(here.join("copy")).unwrap();
    std::fs::copy(here.join("linear.npz"), here.join("copy/linear.npz")).unwrap();
    let others = ["--compare-artifact", "linear.npz", "--compare-artifact", "copy/linear.npz"];
    let quick = ["--scan-steps", "2", "--no-relax", "--collision-evaluations", "0"];
    let text = validate(here, "al_eam_1l", "out", &[&quick[..], &others].concat());
    assert!(text.contains("γ (linear.npz)") && text.contains("γ (copy/linear.npz)"), "{text}");
}

/// An artifact has the statistics of its data, from which the axes of the features follow; a mixture in a model's file has none.
#[test]
fn labelled_atoms_are_drawn_among_the_components() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    // The structure without a label is graded and counts nowhere.
    let mut frames = aluminium(3);
    frames.push(Frame::from(frames[0].structure.clone()));
    write_frames(&here.join("labelled.extxyz"), &frames);
    let artifact = config("data/al_eam_1l/gmm_artifacts.npz").display().to_string();
    let labels = ["--labelled", "labelled.extxyz"];
    let quick = [&labels[..], &["--scan-steps", "2", "--no-relax", "--collision-evaluations", "0"]].concat();
    validate(here, "al_eam_1l", "out", &[&quick[..], &["--artifact", &artifact]].concat());
    let found = json(&here.join("out"));
    let [plane] = &found["feature_planes"].as_array().unwrap()[..] else { panic!("{found}") };
    let shares = [0, 1].map(|k| plane["shares"][k].as_f64().unwrap());
    assert!(shares[0] >= shares[1] && shares[1] > 0.0 && shares[0] + shares[1] <= 1.0, "{plane}");
    let [within, beyond] = [0, 1].map(|k| plane["atoms"][k].as_u64().unwrap());
    assert_eq!(json!(within + beyond), found["labelled"][0]["report"]["atoms"]);
    let kept =
        found["labelled"][0]["report"]["scores"][0]["confident"]["retention"]["value"].as_f64().unwrap();
    assert!((within as f64 / (within + beyond) as f64 - kept).abs() < 1e-12, "{plane}");
    // The axes go along the covariance of the only component, and its centroid is the origin.
    let [component] = &plane["components"].as_array().unwrap()[..] else { panic!("{plane}") };
    let covariance = [0, 1, 2].map(|k| component["covariance"][k].as_f64().unwrap());
    assert!(covariance[1].abs() < 1e-9 * covariance[0], "{plane}");
    assert!((covariance[2] / covariance[0] - shares[1] / shares[0]).abs() < 1e-9, "{plane}");
    let rows = std::fs::read_to_string(here.join("out/figures/feature-space.csv")).unwrap();
    assert_eq!(rows.lines().filter(|row| row.starts_with("Al,γ ≤ 1,")).count() as u64, within);
    let page = std::fs::read_to_string(here.join("out/validation.html")).unwrap();
    assert!(page.contains("id=\"table-feature-space\"") && page.contains("largest condition number"));

    validate(here, "al_eam_1l", "bare", &quick[2..]);
    assert_eq!(json(&here.join("bare"))["feature_planes"], json!([]));
    let page = std::fs::read_to_string(here.join("bare/validation.html")).unwrap();
    assert!(page.contains("has no statistics of its data"));
}

/// Each mixture grades the same structures; the features follow from its artifact.
#[test]
fn mixtures_of_several_dimensions_are_compared() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let model = config("data/al_eam_1l/kokkos.npz").display().to_string();
    mixture_of(here, "linear", "linear.npz");
    write_frames(&here.join("labelled.extxyz"), &aluminium(4));
    let own = config("data/al_eam_1l/gmm_artifacts.npz").display().to_string();
    let others = ["--compare-artifact", &own, "--compare-artifact", "linear.npz"];
    let labels = ["--labelled", "labelled.extxyz"];
    let quick = [&labels[..], &["--scan-steps", "2", "--no-relax", "--collision-evaluations", "0"]].concat();
    let printed = validate(here, "al_eam_1l", "out", &[&quick[..], &others[..]].concat());
    assert!(printed.contains("under several mixtures") && printed.contains("linear.npz"), "{printed}");
    let found = json(&here.join("out"));
    let mixtures = found["labelled"][0]["mixtures"].as_array().unwrap();
    let described: Vec<_> =
        mixtures.iter().map(|mixture| json!([mixture["dimension"], mixture["components"]])).collect();
    assert_eq!(Value::from(described), json!([[130, [1]], [130, [1]], [128, [1]]]));
    assert_eq!(
        (&mixtures[1]["artifact"], &mixtures[1]["scores"]),
        (&own.as_str().into(), &mixtures[0]["scores"])
    );
    assert_eq!(mixtures[0]["scores"], found["labelled"][0]["report"]["scores"]);
    assert_ne!(mixtures[2]["scores"][0]["spearman"], mixtures[0]["scores"][0]["spearman"]);
    let table = std::fs::read_to_string(here.join("out/tables/mixtures.csv")).unwrap();
    assert_eq!(table.lines().count(), 7, "{table}");
    assert!(table.lines().next().unwrap().ends_with(",AUC > 1 eV/Å,interval"), "{table}");
    let page = std::fs::read_to_string(here.join("out/validation.html")).unwrap();
    assert!(page.contains("id=\"table-mixtures\"") && page.contains("id=\"figure-mixture-contamination\""));
    // Two curves for each mixture, and one of all atoms.
    let curves = std::fs::read_to_string(here.join("out/figures/mixture-contamination.csv")).unwrap();
    let kept = &mixtures[2]["scores"][1]["confident"]["contamination"];
    assert_eq!(curves.lines().count(), 1 + 7 * kept.as_array().unwrap().len());
    let linear = curves.lines().find(|line| line.starts_with("γ_nbr,3,128,1,")).unwrap();
    let numbers = linear.strip_prefix("γ_nbr,3,128,1,").unwrap();
    let numbers: Vec<f64> = numbers.split(',').take(2).map(|number| number.parse().unwrap()).collect();
    assert!(deviation(&numbers, &[0.01, kept[0]["value"].as_f64().unwrap()]) < 1e-12, "{linear}");

    let silicon = config("data/si_sw_1l/gmm_artifacts.npz").display().to_string();
    let start = ["calm", "validate", "--model", &model, "--output", "new"];
    let message = refuse(here, start.iter().chain(&["--compare-artifact", &silicon]));
    assert!(message.contains("si_sw_1l"), "{message}");
    assert!(!here.join("new").join("validation.json").exists());
}
