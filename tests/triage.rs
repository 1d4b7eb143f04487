//! Checks of seed structures by `validate` and `estimate` before a campaign starts.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;
use std::path::Path;

use atoms::read_extxyz;
use serde_json::{Value, json};

use crate::common::campaign::Small;
use crate::common::npz::with_changed_arrays;
use crate::common::{calmwalk, config, demo, program, refuse, stderr, succeed, write_frames};

/// `n`³ atoms of simple cubic aluminium with the edge `a`, Å, whose first atom is displaced.
fn cubic(name: &str, n: u8, a: f64, displacement: f64) -> String {
    let edge = f64::from(n) * a;
    let mut text = format!(
        "{}\nLattice=\"{edge} 0 0 0 {edge} 0 0 0 {edge}\" Properties=species:S:1:pos:R:3 name={name}\n",
        usize::from(n).pow(3)
    );
    for atom in 0..n.pow(3) {
        let [x, y, z] = [atom / n / n, atom / n % n, atom % n].map(|place| a * f64::from(place));
        let x = if atom == 0 { x + displacement } else { x };
        writeln!(text, "Al {x} {y} {z}").unwrap();
    }
    text
}

/// Writes a campaign with these structures after those of [`Small`].
fn write(here: &Path, more: &str) {
    Small::default().write(here);
    let known = fs::read_to_string(here.join("seeds.extxyz")).unwrap();
    fs::write(here.join("seeds.extxyz"), known + more).unwrap();
}

/// The rows of a CSV by their first cell; its cells have no commas or quotes.
fn rows(path: &Path) -> BTreeMap<String, BTreeMap<String, String>> {
    let text = fs::read_to_string(path).unwrap();
    let mut lines = text.lines().map(|line| line.split(',').map(str::to_owned).collect::<Vec<_>>());
    let titles = lines.next().unwrap();
    let row = |cells: Vec<String>| (cells[0].clone(), titles.iter().cloned().zip(cells).collect());
    lines.map(row).collect()
}

/// Simple cubic aluminium that is far too dilute: its energy has a negative curvature.
#[test]
fn cells_that_no_bias_can_drive_are_found_before_the_walks() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write(here, &cubic("dilute", 3, 3.6, 0.0));
    let config = here.join("campaign.toml");
    let text = fs::read_to_string(&config).unwrap();
    let ramp = "volume_ramp = { from = 1.0, to = 1.25 }\n";
    assert!(text.contains(ramp));
    let with = |cell_bias: &str| {
        let keys = format!("barostat = {{}}\ncell_bias = {{ {cell_bias} }}\n");
        fs::write(&config, text.replace(ramp, &keys)).unwrap();
        let shown = succeed(here, ["validate", "campaign.toml", "--csv", "seeds.csv"]);
        (shown, rows(&here.join("seeds.csv")))
    };
    let (shown, rows) = with("");
    assert_eq!(rows["dilute"]["state"], "unstable_cell", "{rows:?}");
    assert!(rows["dilute"]["remark"].contains("GPa): give walk.cell_bias.stress_scale"), "{rows:?}");
    assert!(shown.contains("1 of 3 seed structures have no positive bulk modulus"), "{shown}");
    assert_ne!(rows["vacancy"]["state"], "unstable_cell");
    let (_, rows) = with("stress_scale = 76.0");
    assert_ne!(rows["dilute"]["state"], "unstable_cell");
}

#[test]
fn seed_structures_are_graded_and_measured() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let close = cubic("close", 3, 2.8, 2.7);
    let seeds =
        [cubic("cubic", 3, 2.8, 0.0), cubic("strained", 3, 2.5, 0.5), cubic("large", 5, 2.8, 0.0), close];
    write(here, &seeds.concat());
    let shown = succeed(here, ["validate", "campaign.toml", "--csv", "seeds.csv"]);
    let rows = rows(&here.join("seeds.csv"));
    assert_eq!(rows.len(), 6);
    let text = |name: &str, column: &str| rows[name][column].as_str();
    let number = |name: &str, column: &str| rows[name][column].parse::<f64>().unwrap();

    // The grades equal those of `calm score`.
    let [model, artifact] =
        ["kokkos.npz", "gmm_artifacts.npz"].map(|name| config(&format!("data/al_eam_1l/{name}")));
    let (model, artifact) = (model.display().to_string(), artifact.display().to_string());
    fs::write(here.join("graded.extxyz"), seeds[..3].concat()).unwrap();
    let score = [
        "calm",
        "score",
        "--model",
        &model,
        "--artifact",
        &artifact,
        "graded.extxyz",
        "--output",
        "scored.extxyz",
    ];
    succeed(here, score);
    for (frame, name) in
        read_extxyz(&here.join("scored.extxyz")).unwrap().iter().zip(["cubic", "strained", "large"])
    {
        let gamma = frame.arrays["gamma"].reals().unwrap();
        let max = gamma.iter().copied().fold(0.0, f64::max);
        assert!((number(name, "gamma_max") / max - 1.0).abs() < 1e-9, "{name}");
        let above = gamma.iter().filter(|gamma| **gamma > 1.0).count();
        assert_eq!(text(name, "atoms_above"), above.to_string());
        let needed = if name == "large" { 13 } else { 3 };
        assert_eq!(text(name, "atoms_needed"), needed.to_string());
        let state = if above >= needed { "candidate" } else { "ready" };
        assert_eq!(text(name, "state"), state, "{name}");
    }
    let candidates = rows.values().filter(|row| row["state"] == "candidate").count();
    assert!(candidates > 0 && text("fcc-100", "state") == "ready", "{rows:?}");
    assert!(
        shown.contains(&format!("{candidates} of 5 seed structures meet the collection rule")),
        "{shown}"
    );

    assert_eq!((text("close", "state"), text("close", "gamma_max")), ("skipped", ""));
    assert_eq!((text("cubic", "closest_pair"), text("cubic", "formula")), ("Al-Al", "Al27"));
    assert!(
        (number("cubic", "distance") - 2.8).abs() < 1e-9 && (number("cubic", "limit") - 2.1).abs() < 1e-9
    );

    let valid: Value = serde_json::from_str(&succeed(here, ["validate", "campaign.toml", "--json"])).unwrap();
    let found = valid["seed_structures"].as_array().unwrap();
    assert!(
        found.iter().all(|one| one["state"] == text(one["seed_structure"].as_str().unwrap(), "state")),
        "{valid}"
    );
    assert_eq!((found.len(), &valid["skipped"][0]["seed_structure"]), (5, &Value::from("close")));

    // Times per step scale with atoms and neighbours.
    let work = |name: &str| number(name, "atoms") * (1.0 + number(name, "neighbours_per_atom"));
    for hours in ["walk_hours", "control_hours"] {
        let time = |name: &str| number(name, hours);
        assert!(time("cubic") > 0.0 && time("large") > 0.0);
        assert!((time("cubic") / time("strained") / (work("cubic") / work("strained")) - 1.0).abs() < 1e-9);
    }
}

#[test]
fn an_estimate_examines_seed_structures_too() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let seeds = [cubic("cubic", 3, 2.8, 0.0), cubic("strained", 3, 2.5, 0.5), cubic("close", 3, 2.8, 2.7)];
    write(here, &seeds.concat());
    let shown = succeed(here, ["estimate", "campaign.toml", "--csv", "seeds.csv"]);
    let rows = rows(&here.join("seeds.csv"));
    assert_eq!((rows.len(), rows["close"]["state"].as_str()), (5, "skipped"));
    let candidates = rows.values().filter(|row| row["state"] == "candidate").count();
    let remark = format!("\n  start    {candidates} of 4 seed structures meet the collection rule");
    let tables = ["\nseed structure  labels  atoms", "\nseed structure  atoms  formula  closest pair"];
    assert!(candidates > 0 && shown.contains(&remark), "{shown}");
    assert!(tables.iter().all(|titles| shown.contains(titles)), "{shown}");

    let plan: Value = serde_json::from_str(&succeed(here, ["estimate", "campaign.toml", "--json"])).unwrap();
    for seed in plan["seed_structures"].as_array().unwrap() {
        let (row, found) = (&rows[seed["seed_structure"].as_str().unwrap()], &seed["triage"]);
        assert_eq!((&found["state"], &found["formula"]), (&json!(row["state"]), &json!(row["formula"])));
        let gamma = found["gamma_max"].as_f64().unwrap();
        assert!((row["gamma_max"].parse::<f64>().unwrap() / gamma - 1.0).abs() < 1e-9, "{found}");
        assert_eq!(found["distances"][0]["pair"], "Al-Al");
    }
    let [skipped] = plan["skipped"].as_array().unwrap().as_slice() else { panic!("{plan}") };
    assert_eq!(skipped["seed_structure"], "close");
    assert!(skipped["reason"].as_str().unwrap().starts_with("the shortest Al-Al distance is "), "{plan}");
}

#[test]
fn the_worst_seed_structures_come_first() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let many: String = (0..30).map(|k| cubic(&format!("c{k}"), 3, 2.6 + 0.01 * f64::from(k), 0.3)).collect();
    let skipped: String = (0..22).map(|k| cubic(&format!("x{k}"), 3, 2.8, 2.7)).collect();
    write(here, &(many + &skipped));
    let table = |arguments: &[&str]| -> Vec<String> {
        let output = calmwalk(here, ["validate", "campaign.toml"].iter().chain(arguments));
        let listed = stderr(&output);
        assert_eq!(output.status.code(), Some(0), "{listed}");
        assert!(listed.contains("'x19' (") && !listed.contains("'x20' ("), "{listed}");
        assert!(listed.contains("2 more seed structures are skipped"), "{listed}");
        let text = String::from_utf8(output.stdout).unwrap();
        let (_, table) = text.split_once("\nseed structure ").unwrap();
        table.lines().skip(1).map(str::to_owned).collect()
    };
    let (shown, all) = (table(&[]), table(&["--all"]));
    assert_eq!(all.len(), 32);
    assert_eq!(shown.last().unwrap(), "… and 12 more seed structures (use --all, or --csv FILE)");
    // The times differ, because they are measured again; the order does not.
    let names = |rows: &[String]| {
        rows.iter().map(|row| row.split(' ').next().unwrap().to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(names(&shown[..20]), names(&all[..20]));
    let is_candidate: Vec<_> =
        all.iter().map(|row| row.ends_with("a candidate before its walk starts")).collect();
    assert!(is_candidate.is_sorted_by(|a, b| a >= b) && is_candidate[0] && !is_candidate[31], "{all:?}");
}

/// Nickel, aluminium and hydrogen, with a mixture that has no data for hydrogen.
#[test]
fn elements_that_the_mixture_has_no_data_of_are_shown() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let artifact = config("data/ni_al_h_eam_1l/gmm_artifacts.npz");
    let without_hydrogen = with_changed_arrays(&artifact, |name, numbers| match name {
        "counts_1" | "effective_count_1" | "scatter_1" => numbers.fill(0.0),
        "inv_cov_1" => {
            // The inverse of the regularisation alone, for each component.
            let dimension = (numbers.len() / 3).isqrt();
            let diagonal = |k: usize| (k % (dimension * dimension)).is_multiple_of(dimension + 1);
            numbers.iter_mut().enumerate().for_each(|(k, x)| *x = if diagonal(k) { 1e6 } else { 0.0 });
        }
        _ => {}
    });
    fs::write(here.join("artifact.npz"), without_hydrogen).unwrap();
    let text = demo("nickel-aluminium-hydrogen.toml");
    fs::write(here.join("c.toml"), text.replace(&artifact.display().to_string(), "artifact.npz")).unwrap();
    let shown = succeed(here, ["validate", "c.toml", "--csv", "seeds.csv"]);
    assert!(
        shown.contains("7 of 8 seed structures have an element that the mixture has no data of"),
        "{shown}"
    );
    for (name, row) in rows(&here.join("seeds.csv")) {
        let expected = if row["formula"].contains('H') { "not_in_mixture" } else { "ready" };
        assert_eq!(row["state"], expected, "{name}: {row:?}");
        assert!((expected == "ready") != row["remark"].contains('H'), "{row:?}");
        let gamma: f64 = row["gamma_max"].parse().unwrap();
        assert!((gamma > 10.0) == (expected != "ready"), "{name}: {gamma}");
    }
}

/// Hydrogen atoms that start 7 Å apart may meet in a walk.
#[test]
fn pairs_of_elements_that_are_far_apart_have_windows_too() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let frames = read_extxyz(&config("data/nickel_aluminium_hydrogen_seeds.extxyz")).unwrap();
    write_frames(&here.join("seeds.extxyz"), &frames[..1]);
    let seeds = config("data/nickel_aluminium_hydrogen_seeds.extxyz").display().to_string();
    let text = demo("nickel-aluminium-hydrogen.toml").replace(&seeds, "seeds.extxyz");
    fs::write(here.join("c.toml"), text).unwrap();
    let shown = succeed(here, ["validate", "c.toml"]);
    let rows: Vec<Vec<_>> = shown.lines().map(|line| line.split_whitespace().collect()).collect();
    let row = rows.iter().find(|row| row.first() == Some(&"H-H")).unwrap_or_else(|| panic!("{shown}"));
    assert_eq!(row[..], ["H-H", "0.62", "–", "0.600", "0.550", "0.780"]);
    assert!(rows.iter().any(|row| row.first() == Some(&"H-Ni")), "{shown}");
}

/// A program without files for an element skips its structures, as a potential does that does not know it.
#[test]
fn structures_that_a_program_cannot_label_are_skipped() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    for element in ["Al", "Ni"] {
        let potcar = format!(
            "VRHFIN ={element}: s2p1\nTITEL = PAW_PBE {element} 01Jan2000\nPOMASS = 1.000; ZVAL = 3.000\nEnd of Dataset\n"
        );
        fs::write(here.join(format!("POTCAR.{element}")), potcar).unwrap();
    }
    let vasp = "method = { vasp = { command = [\"sh\"], version = \"5.4.4\", pseudopotentials = \".\", \
                pseudopotential_variants = { Al = \"Al\", Ni = \"Ni\" } } } #";
    let text = demo("nickel-aluminium-hydrogen.toml").replace("\nmethod = ", &format!("\n{vasp}"));
    fs::write(here.join("c.toml"), &text).unwrap();
    let output = calmwalk(here, ["validate", "c.toml", "--csv", "seeds.csv"]);
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(0), "{said}");
    let expected = ["seed structure 'ni-h' (", ":1) is skipped: pseudopotential of H: none is selected"];
    assert!(expected.iter().all(|words| said.contains(words)), "{said}");
    for (name, row) in rows(&here.join("seeds.csv")) {
        let expected = if row["formula"].contains('H') { "skipped" } else { "ready" };
        assert_eq!(row["state"], expected, "{name}: {row:?}");
    }
    let strict = text.replace("# on_invalid = \"skip\"", "on_invalid = \"error\"");
    fs::write(here.join("c.toml"), strict).unwrap();
    let message = refuse(here, ["validate", "c.toml"]);
    let expected = ["label.method.vasp: pseudopotential of H: ", " (seed structure 'ni-h', "];
    assert!(expected.iter().all(|words| message.contains(words)), "{message}");
}

/// What `validate` warns of, the other commands that load a campaign say too.
#[test]
fn skipped_structures_are_listed_before_a_start() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write(here, &cubic("close", 3, 2.8, 2.7));
    let launch = ["launch", "campaign.toml", "--on", "slurm", "--agents=0", "--directory", ".", "--dry-run"];
    for arguments in [&["estimate", "campaign.toml"][..], &launch[..]] {
        // Hide Slurm's commands, which may be installed without a working Slurm.
        let output = program(here).args(arguments).env("PATH", "").output().unwrap();
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(0), "{said}");
        assert!(said.contains("seed structure 'close' (") && said.contains(") is skipped: "), "{said}");
    }
}

#[test]
fn a_csv_that_cannot_be_written_is_wrong_input() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write(here, "");
    let message = refuse(here, ["validate", "campaign.toml", "--csv", "absent/seeds.csv"]);
    assert!(message.contains("absent/seeds.csv"), "{message}");
}
