//! Statistics of labelled structures by `calm score`, and `calm filter`.

use std::fs;
use std::path::Path;

use atoms::cell::{norm, sub};
use atoms::extxyz::Frame;
use atoms::read_extxyz;
use serde_json::Value as Json;

use crate::common::{calmwalk, config, random, refuse, stderr, succeed, write_frames};

/// Scores frames of aluminium with labels of an EAM potential. Returns the standard output.
fn score(here: &Path, frames: &[Frame], more: &[&str]) -> String {
    write_frames(&here.join("in.extxyz"), frames);
    let model = config("data/al_eam_1l/kokkos.npz");
    let arguments =
        ["calm", "score", "--model", model.to_str().unwrap(), "in.extxyz", "--output", "out.extxyz"];
    succeed(here, arguments.iter().chain(more))
}

fn aluminium(number: usize) -> Vec<Frame> {
    let mut frames = read_extxyz(&config("data/al_eam_1l/seed_frames.extxyz")).unwrap();
    frames.truncate(number);
    frames
}

fn json(path: &Path) -> Json {
    serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap()
}

fn assert_near(found: &Json, expected: f64) {
    let found = found.as_f64().unwrap();
    assert!((found - expected).abs() < 1e-9 * expected.abs().max(1.0), "{found} {expected}");
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let number = values.len() as f64;
    values.sum::<f64>() / number
}

/// Twice the rank of each value, by counting.
fn ranks(values: &[f64]) -> Vec<f64> {
    let rank =
        |x: &f64| values.iter().map(|y| f64::from(u8::from(y < x)) + f64::from(u8::from(y <= x))).sum();
    values.iter().map(rank).collect()
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let (a, b) = (ranks(a), ranks(b));
    let centre = |values: &[f64]| mean(values.iter().copied());
    let product = |x: &[f64], y: &[f64]| -> f64 {
        let (mx, my) = (centre(x), centre(y));
        x.iter().zip(y).map(|(x, y)| (x - mx) * (y - my)).sum()
    };
    product(&a, &b) / (product(&a, &a) * product(&b, &b)).sqrt()
}

#[test]
fn labelled_structures_say_how_far_a_grade_can_be_trusted() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let printed =
        score(here, &aluminium(4), &["--json", "labels.json", "--table", "t.csv", "--figures", "drawn"]);
    let mut drawn: Vec<_> = fs::read_dir(here.join("drawn"))
        .unwrap()
        .map(|file| file.unwrap().file_name().into_string().unwrap())
        .collect();
    drawn.sort();
    let expected = "auc-sweep.csv auc-sweep.png auc-sweep.svg auc-thresholds.csv captions.txt confident.csv contamination.csv \
                    contamination.png contamination.svg error-histograms.csv error-histograms.png error-histograms.svg \
                    label-errors.csv quantiles.csv ranks.csv reliability.csv reliability.png reliability.svg \
         score-distributions.csv score-distributions.png score-distributions.svg";
    assert_eq!(drawn.join(" "), expected);
    for words in ["wrote 4 structures", "4 labelled structures with forces of 432 atoms", "γ_nbr", "γ ≤ 1"]
    {
        assert!(printed.contains(words), "{printed}");
    }
    let scored = read_extxyz(&here.join("out.extxyz")).unwrap();
    let column = |name: &str| -> Vec<f64> {
        scored.iter().flat_map(|frame| frame.arrays[name].reals().unwrap()).collect()
    };
    let (forces, labels) = (column("forces"), column("REF_forces"));
    let difference = |a: &[f64], b: &[f64]| norm(sub(a.try_into().unwrap(), b.try_into().unwrap()));
    let errors: Vec<_> = forces.chunks(3).zip(labels.chunks(3)).map(|(a, b)| difference(a, b)).collect();
    let report = json(&here.join("labels.json"));
    assert_eq!((&report["structures"], &report["atoms"]), (&4.into(), &432.into()));
    let components = forces.iter().zip(&labels).map(|(a, b)| (a - b).abs());
    assert_near(&report["forces"]["mean_absolute"]["value"], mean(components));
    let energy = |frame: &Frame, key: &str| frame.info[key].number().unwrap() / 108.0;
    let energies = scored.iter().map(|frame| (energy(frame, "energy") - energy(frame, "REF_energy")).abs());
    assert_near(&report["energy"]["mean_absolute"]["value"], mean(energies));
    assert_eq!(report["stress"]["number"], 24.0);
    for (k, (name, scores)) in [("γ", column("gamma")), ("γ_{nbr}", column("gamma_nbr"))].iter().enumerate()
    {
        let of = &report["scores"][k];
        assert_eq!(of["name"], *name);
        assert_near(&of["spearman"]["value"], correlation(scores, &errors));
        let interval = &of["spearman"]["interval"];
        assert!(interval[0].as_f64().unwrap() <= interval[1].as_f64().unwrap());
        let kept = scores.iter().filter(|gamma| **gamma <= 1.0).count() as f64 / 432.0;
        assert_near(&of["confident"]["retention"]["value"], kept);
        assert_eq!(of["bins"].as_array().unwrap().len(), 7);
    }
    // The filter reads one row per structure.
    let filter = ["calm", "filter", "t.csv", "--error", "force_error_mean", "--thresholds", "1e9", "--json"];
    let filtered: Json = serde_json::from_str(&succeed(here, filter)).unwrap();
    assert_near(&filtered["steps"][0]["mean_absolute_error"], mean(errors.into_iter()));
    // The output is reproducible, and scored files, which have reference labels, can be scored again.
    write_frames(&here.join("again.extxyz"), &scored);
    assert_eq!(score(here, &scored, &["--json", "again.json"]), printed);
    assert_eq!(json(&here.join("again.json")), report);
}

#[test]
fn without_labels_nothing_is_reported() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let mut frames = aluminium(1);
    let cell = frames[0].structure.clone();
    let printed = score(here, &[Frame::from(cell.clone())], &["--json", "labels.json"]);
    let lines: Vec<_> = printed.lines().collect();
    assert!(
        lines[0] == "wrote 1 structure with grades to out.extxyz" && lines.len() == 3,
        "grades only: {printed}"
    );
    assert_eq!(json(&here.join("labels.json"))["structures"], 0);
    // Structures with unreadable labels are still graded.
    frames[0].info.insert("energy".into(), "unknown".into());
    write_frames(&here.join("bad.extxyz"), &frames);
    let model = config("data/al_eam_1l/kokkos.npz");
    let output =
        calmwalk(here, ["calm", "score", "--model", model.to_str().unwrap(), "bad.extxyz", "-o", "o.extxyz"]);
    assert_eq!(output.status.code(), Some(0));
    let message = stderr(&output);
    assert!(
        message.contains("no statistics of the labels of 1 frame: the frame at line 1: energy is"),
        "{message}"
    );
    let score = ["calm", "score", "--model", model.to_str().unwrap(), "in.extxyz", "-o", "o.extxyz"];
    let message = refuse(here, score.into_iter().chain(["--json", "in.extxyz"]));
    assert!(message.contains("in.extxyz is the input"), "{message}");
}

/// 400 structures whose error is proportional to the grade.
fn table(here: &Path) {
    let mut text = "id,gamma_max,predicted,\"true value\"\n".to_owned();
    for k in 0..400 {
        let number = |n: u64| (random(10 * k + n) >> 11) as f64 / (1_u64 << 53) as f64;
        let (grade, actual) = (2.0 * number(0), number(1) - 0.5);
        let predicted = actual + 0.2 * grade * (number(2) - 0.5);
        text += &format!("\"s, {k}\",{grade},{predicted},{actual}\r\n");
    }
    fs::write(here.join("t.csv"), text).unwrap();
}

#[test]
fn a_grade_that_tells_errors_keeps_better_structures_than_chance() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    table(here);
    let filter = [
        "calm",
        "filter",
        "t.csv",
        "--predicted",
        "predicted",
        "--true",
        "true value",
        "--class-threshold",
        "0",
    ];
    let more = ["--thresholds", "1,0.5,2", "--csv", "sweep.csv", "--figure", "sweep.svg"];
    let printed = succeed(here, filter.iter().chain(&more));
    assert!(printed.starts_with("400 structures; random: mean"), "{printed}");
    let found: Json =
        serde_json::from_str(&succeed(here, filter.iter().chain(&more).chain(&["--json"]))).unwrap();
    let steps = found["steps"].as_array().unwrap();
    assert_eq!(
        steps.iter().map(|step| step["threshold"].as_f64().unwrap()).collect::<Vec<_>>(),
        [0.5, 1.0, 2.0]
    );
    let error = "mean_absolute_error";
    for step in &steps[..2] {
        let [value, mean, deviation] =
            [&step[error], &step["random_mean"][error], &step["random_deviation"][error]]
                .map(|x| x.as_f64().unwrap());
        assert!(value < mean - 3.0 * deviation, "{step}");
        assert!(step["f1"].as_f64() > step["random_mean"]["f1"].as_f64(), "{step}");
    }
    // A threshold of 2 keeps every structure.
    assert_eq!((&steps[2]["kept"], &steps[2][error]), (&400.into(), &found["unfiltered"][error]));
    let rows = fs::read_to_string(here.join("sweep.csv")).unwrap();
    assert_eq!(rows.lines().count(), 5);
    assert!(
        rows.starts_with("threshold,kept,share,mean_absolute_error,mean_absolute_error_random_mean,"),
        "{rows}"
    );
    let figure = fs::read_to_string(here.join("sweep.svg")).unwrap();
    assert!(figure.contains("precision") && figure.contains("gamma_max") && !figure.contains("NaN"));
    // The page has the same sweep.
    let page = ["--thresholds", "1,0.5,2", "--output", "page"];
    let printed = succeed(here, filter.iter().chain(&page));
    assert!(printed.ends_with("wrote page/filter.html and 8 files in the same directory\n"), "{printed}");
    let written = |name: &str| fs::read_to_string(here.join("page").join(name)).unwrap();
    assert_eq!(json(&here.join("page/filter.json")), found);
    assert_eq!((written("figures/filter.csv"), written("figures/filter.svg")), (rows, figure));
    let html = written("filter.html");
    for words in ["id=\"figure-errors\"", "id=\"table-thresholds\"", "400 structures", "40 random subsets"] {
        assert!(html.contains(words), "{words}");
    }
    let table = written("tables/thresholds.csv");
    assert!(table.starts_with("threshold,kept,kept (%),MAE,random MAE,± MAE,precision,"), "{table}");
    assert_eq!(table.lines().count(), 5);
    fs::create_dir_all(here.join("own/tables")).unwrap();
    fs::copy(here.join("t.csv"), here.join("own/tables/thresholds.csv")).unwrap();
    let own = ["calm", "filter", "own/tables/thresholds.csv", "--error", "predicted", "--output", "own"];
    assert!(refuse(here, own).contains("own/tables/thresholds.csv is the table"));
    // Without classes there are only errors.
    let printed = succeed(
        here,
        ["calm", "filter", "t.csv", "--error", "predicted", "--draws", "0", "--figure", "f.png"],
    );
    assert!(!printed.contains("F1") && printed.contains("–"), "{printed}");
}

/// A table that pandas writes has `True` and `False` in columns of classes.
#[test]
fn classes_are_numbers_or_words() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let filter = |rows: &[&str]| -> Json {
        fs::write(here.join("t.csv"), format!("gamma_max,pred,true\n{}\n", rows.join("\n"))).unwrap();
        let classes = ["--predicted", "pred", "--true", "true", "--class-threshold", "0.5", "--class-above"];
        let filter = ["calm", "filter", "t.csv", "--thresholds", "1", "--json"];
        serde_json::from_str(&succeed(here, filter.iter().chain(&classes))).unwrap()
    };
    let found = filter(&["0.5,True,True", "0.8,False,True", "0.9,true,FALSE", "2,False,False"]);
    assert_eq!(found, filter(&["0.5,1,1", "0.8,0,1", "0.9,1,0", "2,0,0"]));
    // The mean absolute error is the share of wrong classes.
    assert_near(&found["unfiltered"]["mean_absolute_error"], 0.5);
    assert_near(&found["steps"][0]["mean_absolute_error"], 2.0 / 3.0);
    assert_eq!(
        (&found["unfiltered"]["precision"], &found["unfiltered"]["recall"]),
        (&0.5.into(), &0.5.into())
    );
}

#[test]
fn hostile_tables_are_refused_with_their_place() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    for (text, reason) in [
        ("", "t.csv: no rows"),
        ("gamma_max,error\n", "t.csv: no row has all numbers"),
        ("gamma,error\n1,2\n", "t.csv: no column is called 'gamma_max', the columns are gamma, error"),
        ("gamma_max,error,error\n1,2,3\n", "t.csv: two columns are called 'error'"),
        ("gamma_max,error\n1,2\n1\n", "t.csv:3: found 1 cells, expected 2"),
        ("gamma_max,error\n1,2\n\n1,2 meV\n", "t.csv:4: column 'error' is '2 meV', expected a finite number"),
        ("gamma_max,error\ninf,2\n", "t.csv:2: column 'gamma_max' is 'inf'"),
        ("gamma_max,error\n1,\n", "t.csv:2: column 'error' has no number"),
        ("gamma_max,error\n1,NaN\n", "--skip-missing leaves such rows out"),
        ("gamma_max,error\n1,\"2\n", "t.csv:2: a quoted cell does not end"),
        ("gamma_max,error\n1,\"2\"0\n", "t.csv:2: found '0' after quoted cell 2"),
    ] {
        fs::write(here.join("t.csv"), text).unwrap();
        let message = refuse(here, ["calm", "filter", "t.csv", "--error", "error"]);
        assert!(message.contains(reason), "{message}");
    }
    fs::write(here.join("t.csv"), [0xff, 0xfe, b'\n']).unwrap();
    assert!(refuse(here, ["calm", "filter", "t.csv", "--error", "e"]).contains("t.csv:1: cannot be read"));
    fs::write(here.join("t.csv"), "gamma_max,error\n1,\n2,0.5\n").unwrap();
    let printed = succeed(here, ["calm", "filter", "t.csv", "--error", "error", "--skip-missing"]);
    assert!(printed.starts_with("1 structure, 1 left out"), "{printed}");
    for (arguments, reason) in [
        (vec!["--error", "error", "--figure", "f.pdf"], "ends in .svg or .png"),
        (vec!["--error", "error", "--csv", "t.csv"], "t.csv is the table"),
        (vec!["--error", "error", "--predicted", "a", "--true", "b"], "cannot be used with"),
        (vec!["--predicted", "a"], "--true"),
        (vec!["--error", "error", "--class-threshold", "0"], "cannot be used with"),
        (vec!["--error", "error", "--thresholds", "1,x"], "expected a finite number"),
        (vec![], "--error"),
    ] {
        let message = refuse(here, ["calm", "filter", "t.csv"].into_iter().chain(arguments));
        assert!(message.contains(reason), "{message}");
    }
    assert!(
        refuse(here, ["calm", "filter", "absent.csv", "--error", "e"])
            .contains("absent.csv: cannot be opened")
    );
}
