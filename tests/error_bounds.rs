//! Bounds of the force error in a whole campaign with enough labels: `force-errors`, `explain`, `calm score --calibration`, the dashboard.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use atoms::cell::{norm, sub};
use serde_json::Value as Json;
use store::{ExportFilter, ExportSource, Store};

use crate::common::campaign::Small;
use crate::common::http::{get_computed, said};
use crate::common::{Running, config, program, succeed};

/// Edges of the bins of γ_nbr.
const EDGES: [f64; 6] = [0.5, 0.75, 1.0, 1.5, 2.0, 5.0];

fn json(here: &Path, arguments: &[&str]) -> Json {
    serde_json::from_str(&succeed(here, [arguments, &["--json"]].concat())).unwrap()
}

/// The errors of the atoms of a structure in each bin.
type Binned = BTreeMap<usize, Vec<f64>>;

/// Each labelled structure by its name.
fn labelled(directory: &Path) -> BTreeMap<String, Binned> {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let rows = runtime.block_on(async {
        let store = Store::open_read_only(directory).await.unwrap();
        let protocol = store.protocol_in_force().await.unwrap().unwrap().hash;
        let filter = ExportFilter { protocol, biased: true, control: true, imported: false };
        store.labelled(&filter, None, u32::MAX).await.unwrap()
    });
    let mut all = BTreeMap::new();
    for row in rows {
        let ExportSource::Candidate { id, block, original, .. } = &row.source else { panic!("an import") };
        let mut binned = Binned::new();
        for ((model, label), grade) in
            block.view().forces.iter().zip(&row.label.forces).zip(&original.gamma_nbr)
        {
            let bin = EDGES.partition_point(|edge| edge < grade);
            binned.entry(bin).or_default().push(norm(sub(*model, *label)));
        }
        all.insert(id.clone(), binned);
    }
    all
}

/// The smallest error b with Σⱼ (share of structure j below b) / n ≥ q (1 + 1/n).
fn bound(structures: &[&Vec<f64>], level: f64) -> f64 {
    let weighted = |errors: &&Vec<f64>| {
        let weight = 1.0 / errors.len() as f64;
        errors.iter().map(move |error| (*error, weight)).collect::<Vec<_>>()
    };
    let mut all: Vec<_> = structures.iter().flat_map(weighted).collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (mut below, number) = (0.0, structures.len() as f64);
    let reaches = |(_, weight): &&(f64, f64)| {
        below += weight;
        below >= level * (number + 1.0) - 1e-6
    };
    all.iter().find(reaches).map_or(f64::INFINITY, |(error, _)| *error)
}

/// A campaign that collects 64 structures, without looking for news in them.
fn campaign(here: &Path) {
    let path = Small { steps: 340, max_per_walk: 32, ..Small::default() }.write(here);
    let mut text = fs::read_to_string(&path).unwrap();
    for (from, to) in [
        ("rng_seed = 7\n", "rng_seed = 7\ncontrol = false\n"),
        ("[calm]\n", "[calm]\nupdate = \"never\"\n"),
        ("threshold = 1.0, fraction = 0.1 }", "threshold = 0.2, fraction = 0.03 }"),
        ("min_interval = 30", "min_interval = 10"),
    ] {
        assert!(text.contains(from), "no {from}");
        text = text.replacen(from, to, 1);
    }
    fs::write(&path, text).unwrap();
    succeed(here, ["run", "campaign.toml"]);
}

#[test]
fn bounds_are_those_of_the_labels_in_every_view() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    campaign(here);
    let structures = labelled(&here.join("campaign"));
    assert_eq!(structures.len(), 64);
    let errors = json(here, &["force-errors", "campaign", "--calibration", "bounds.json"]);
    let calibration = &errors["calibration"];
    let note = calibration["note"].as_str().unwrap();
    assert!(note.contains("90 % of force errors are below ") && note.contains("; that held for "), "{note}");
    let bounds = of_the_labels(calibration, &structures);
    assert!(bounds.len() > 1, "{calibration}");
    let file: Json = serde_json::from_str(&fs::read_to_string(here.join("bounds.json")).unwrap()).unwrap();
    assert_eq!((&file["found"], &file["by_value"]), (&calibration["found"], &Json::Null));

    explained(here, &structures);
    scored(here, &bounds);
    let mut command = program(here);
    command.args(["dashboard", "campaign", "--address", "127.0.0.1:0"]);
    let mut shown = Running(command.stderr(std::process::Stdio::piped()).spawn().unwrap());
    let [address] = said(&mut shown.0, ["dashboard at http://"]);
    let address = address.split(['/', '#']).next().unwrap();
    assert_eq!(get_computed(address, "/api/errors")["calibration"], *calibration);
}

/// Recomputes the bound of each bin that has one. No bin has had to forget a structure.
fn of_the_labels(calibration: &Json, structures: &BTreeMap<String, Binned>) -> BTreeMap<usize, f64> {
    let mut bounds = BTreeMap::new();
    for bin in calibration["found"]["bins"].as_array().unwrap().iter().filter(|bin| bin["element"].is_null())
    {
        let place = bin["above"].as_f64().map_or(0, |above| EDGES.partition_point(|edge| *edge <= above));
        let errors: Vec<_> = structures.values().filter_map(|of| of.get(&place)).collect();
        assert_eq!(bin["structures"].as_u64(), Some(errors.len() as u64));
        let Some(found) = bin["bound"].as_f64() else { continue };
        let expected = bound(&errors, bin["level_in_force"].as_f64().unwrap());
        assert!(errors.len() >= 20 && (found - expected).abs() < 1e-9, "{bin} {expected}");
        bounds.insert(place, found);
    }
    bounds
}

/// A structure tells what was expected of it before its label came.
fn explained(here: &Path, structures: &BTreeMap<String, Binned>) {
    for (name, binned) in structures {
        let expected = &json(here, &["explain", "campaign", name])["expected_errors"];
        let worst = &expected["worst"];
        let (bin, errors) = binned.last_key_value().unwrap();
        let gamma_nbr = worst["gamma_nbr"].as_f64().unwrap();
        assert_eq!(EDGES.partition_point(|edge| *edge < gamma_nbr), *bin, "{expected}");
        let error = worst["error"].as_f64().unwrap();
        assert!(errors.iter().any(|found| (found - error).abs() < 1e-9), "{expected} {errors:?}");
        if let Some(bound) = worst["bound"].as_f64() {
            let words = succeed(here, ["explain", "campaign", name]);
            let held = if error <= bound { "that held:" } else { "that did not hold:" };
            assert!(words.contains(&format!("are below {bound:.3} eV/Å")) && words.contains(held), "{words}");
            return;
        }
    }
    panic!("no structure had a bound before its label came");
}

/// Structures of a file get the bound of their worst atom.
fn scored(here: &Path, bounds: &BTreeMap<usize, f64>) {
    let path = |file: &str| config(&format!("data/al_eam_1l/{file}")).display().to_string();
    succeed(here, ["export", "campaign", "--output", "dataset.extxyz"]);
    let (model, artifact) = (path("kokkos.npz"), path("gmm_artifacts.npz"));
    let said = succeed(
        here,
        [
            "calm",
            "score",
            "--model",
            &model,
            "--artifact",
            &artifact,
            "dataset.extxyz",
            "-o",
            "graded.extxyz",
            "--calibration",
            "bounds.json",
            "--table",
            "graded.csv",
        ],
    );
    assert!(said.contains("90 % of force errors are below "), "{said}");
    let table = fs::read_to_string(here.join("graded.csv")).unwrap();
    let titles: Vec<_> = table.lines().next().unwrap().split(',').collect();
    let column =
        |name: &str| titles.iter().position(|title| *title == name).unwrap_or_else(|| panic!("{titles:?}"));
    let (grade, bound) = (column("gamma_nbr_max"), column("force_error_bound"));
    let mut found = 0;
    for row in table.lines().skip(1) {
        let cells: Vec<_> = row.split(',').collect();
        let bin = EDGES.partition_point(|edge| *edge < cells[grade].parse::<f64>().unwrap());
        match (bounds.get(&bin), cells[bound].parse::<f64>()) {
            (Some(expected), Ok(bound)) => assert!((bound - expected).abs() < 1e-3 * expected, "{row}"),
            (None, Err(_)) => continue,
            other => panic!("{other:?}: {row}"),
        }
        found += 1;
    }
    assert!(found > 10, "{table}");
}
