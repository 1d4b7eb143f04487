//! Errors derived from labels: `calmwalk force-errors`, `calmwalk report`, and failed labels in `status` and the summary.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use atoms::cell::{norm, sub};
use serde_json::Value as Json;
use store::{ExportFilter, ExportRow, ExportSource, Store};

use crate::common;
use crate::common::campaign::Small;
use crate::common::succeed;

fn json<const N: usize>(here: &Path, arguments: [&str; N]) -> Json {
    serde_json::from_str(&succeed(here, arguments.into_iter().chain(["--json"]))).unwrap()
}

/// Every labelled structure of a campaign.
fn labelled(directory: &Path) -> Vec<ExportRow> {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let store = Store::open_read_only(directory).await.unwrap();
        let protocol = store.protocol_in_force().await.unwrap().unwrap().hash;
        let filter = ExportFilter { protocol, biased: true, control: true, imported: false };
        store.labelled(&filter, None, u32::MAX).await.unwrap()
    })
}

fn max_force(row: &ExportRow) -> f64 {
    row.label.forces.iter().map(|force| norm(*force)).fold(0.0, f64::max)
}

fn content(row: &ExportRow) -> String {
    let ExportSource::Candidate { block, .. } = &row.source else { panic!("an import") };
    block.view().id().content.to_string()
}

/// Mean absolute errors of the force components of pairs (biased, control), and the number of pairs that are one structure.
fn force_maes(directory: &Path) -> (Vec<[f64; 2]>, usize) {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let matched = runtime.block_on(async {
        let store = Store::open_read_only(directory).await.unwrap();
        store.matched_walks().await.unwrap()
    });
    let mae = |row: &ExportRow| {
        let ExportSource::Candidate { block, .. } = &row.source else { panic!("an import") };
        let components = block.view().forces.iter().flatten().zip(row.label.forces.iter().flatten());
        let errors: Vec<_> = components.map(|(model, label)| (model - label).abs()).collect();
        errors.iter().sum::<f64>() / errors.len() as f64
    };
    let rows = labelled(directory);
    let place = |row: &ExportRow| {
        let ExportSource::Candidate { block, .. } = &row.source else { panic!("an import") };
        let id = block.view().id();
        (id.walk.0, id.step)
    };
    let (mut pairs, mut same) = (Vec::new(), 0);
    for control in &rows {
        let (walk, step) = place(control);
        let Some(partner) = matched.get(&walk) else { continue };
        for biased in rows.iter().filter(|row| place(row) == (*partner, step)) {
            match content(biased) == content(control) {
                true => same += 1,
                false => pairs.push([mae(biased), mae(control)]),
            }
        }
    }
    (pairs, same)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    0.5 * (values[(values.len() - 1) / 2] + values[values.len() / 2])
}

/// (γ, force error) of every atom.
fn pairs(rows: &[&ExportRow]) -> Vec<(f64, f64)> {
    let mut pairs = Vec::new();
    for row in rows {
        let ExportSource::Candidate { block, original, .. } = &row.source else { panic!("an import") };
        let forces = block.view().forces.iter().zip(&row.label.forces);
        pairs.extend(original.gamma.iter().copied().zip(forces.map(|(a, b)| norm(sub(*a, *b)))));
    }
    pairs
}

/// Spearman's ρ by counting: a rank is the number of smaller values plus half the number of equal ones.
fn spearman(pairs: &[(f64, f64)]) -> f64 {
    let rank = |value: f64, of: &dyn Fn(&(f64, f64)) -> f64| {
        let smaller = pairs.iter().filter(|pair| of(pair) < value).count() as f64;
        smaller + 0.5 * pairs.iter().filter(|pair| of(pair) == value).count() as f64
    };
    let ranks: Vec<_> = pairs.iter().map(|p| (rank(p.0, &|p| p.0), rank(p.1, &|p| p.1))).collect();
    let middle = 0.5 * pairs.len() as f64;
    let sum =
        |f: &dyn Fn(f64, f64) -> f64| -> f64 { ranks.iter().map(|(a, b)| f(a - middle, b - middle)).sum() };
    sum(&|a, b| a * b) / (sum(&|a, _| a * a) * sum(&|_, b| b * b)).sqrt()
}

fn atoms_in(bin: &Json, pairs: &[(f64, f64)]) -> usize {
    let above = bin["above"].as_f64().unwrap_or(f64::NEG_INFINITY);
    let up_to = bin["up_to"].as_f64().unwrap_or(f64::INFINITY);
    pairs.iter().filter(|(gamma, _)| *gamma > above && *gamma <= up_to).count()
}

/// The bias is zero at the first biased step, so the control walk has the same structure there.
#[test]
fn structures_of_both_walks_are_counted_and_not_compared() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let path = Small { max_per_walk: 2, ..Small::default() }.write(here);
    let text = fs::read_to_string(&path).unwrap();
    let text = text.replacen("threshold = 1.0, fraction = 0.1", "threshold = 0.01, fraction = 0.1", 1);
    fs::write(&path, text.replace("[calm]\n", "[calm]\nupdate = \"never\"\n")).unwrap();
    let summary = succeed(here, ["run", "campaign.toml"]);
    let words = "4 biased and 4 control structures labelled (2 of them by both and not compared: 6 labels)\n";
    assert!(summary.contains(words), "{summary}");
    let status = json(here, ["status", "campaign"]);
    assert_eq!((&status["labels"]["labelled"], &status["shared_structures"]), (&6.into(), &2.into()));
    assert_eq!((&status["candidates"]["accepted"], &status["candidates"]["control"]), (&4.into(), &4.into()));
    let shown = succeed(here, ["status", "campaign", "--all"]);
    assert!(
        shown.contains("4 control frames (2 of them also found by biased walks: 6 labels in total)"),
        "{shown}"
    );
    let errors = json(here, ["force-errors", "campaign"]);
    let structures = ["all", "biased", "control"].map(|of| errors[of]["structures"].as_u64().unwrap());
    assert_eq!((structures, &errors["shared_structures"]), ([6, 2, 2], &2.into()));
    let compared = &errors["biased_against_control"];
    let (pairs, same) = force_maes(&here.join("campaign"));
    let counts = &compared["pairs"]["counts"];
    assert_eq!((counts["pairs"].as_u64(), counts["same_structure"].as_u64()), (Some(2), Some(2)));
    assert_eq!((pairs.len(), same), (2, 2));
    let pooled = ["all", "biased", "control"].map(|of| compared["pooled"][of]["structures"].as_u64());
    assert_eq!(pooled, [6, 2, 2].map(Some));
    succeed(here, ["report", "campaign", "-o", "report"]);
    let page = fs::read_to_string(here.join("report/report.html")).unwrap();
    assert!(page.contains("2 structures found by both biased walks and their controls are excluded"));
}

#[test]
fn failed_labels_are_censored_and_the_others_are_measured() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let config = Small::default().write(here);
    succeed(here, ["run", "campaign.toml", "--directory", "whole"]);
    // A structure that both walks found has one label.
    let (mut rows, mut seen) = (labelled(&here.join("whole")), BTreeSet::new());
    rows.retain(|row| seen.insert(content(row)));
    let mut forces: Vec<_> = rows.iter().map(max_force).collect();
    forces.sort_by(f64::total_cmp);
    // The same campaign, but a third of the labels exceeds the maximum force.
    let limit = forces[forces.len() * 2 / 3];
    let text = fs::read_to_string(&config).unwrap();
    let text = text.replace("[label]", &format!("[label]\nmax_force = {limit}\nmax_attempts = 1"));
    fs::write(here.join("strict.toml"), text).unwrap();
    let summary = succeed(here, ["run", "strict.toml", "--directory", "strict"]);
    let (kept, lost): (Vec<_>, Vec<_>) = rows.iter().partition(|row| max_force(row) <= limit);
    assert!(lost.len() > 1 && kept.len() > 1, "{forces:?}");

    let errors = json(here, ["force-errors", "strict"]);
    let (measured, unknown) = (pairs(&kept), pairs(&lost));
    let all = &errors["all"];
    assert_eq!(
        (all["structures"].as_u64(), all["atoms"].as_u64()),
        (Some(kept.len() as u64), Some(measured.len() as u64))
    );
    let found = all["gamma"]["spearman"].as_f64().unwrap();
    assert!((found - spearman(&measured)).abs() < 1e-9, "{found}");
    let bins = all["gamma"]["bins"].as_array().unwrap();
    assert_eq!(bins.len(), 7);
    for bin in bins {
        assert_eq!(bin["atoms"], atoms_in(bin, &measured), "{bin}");
        assert_eq!(bin["atoms_without_label"], atoms_in(bin, &unknown), "{bin}");
    }
    let of_bin = |key: &str, key_in: &str| -> usize {
        let bins = errors[key].as_array().unwrap();
        bins.iter().map(|bin| bin[key_in].as_array().map_or(0, Vec::len)).sum()
    };
    assert_eq!(of_bin("completion_by_gamma", "failed"), lost.len());
    assert_eq!(of_bin("completion_by_relative_volume", "failed"), lost.len());
    let text = succeed(here, ["force-errors", "strict"]);
    assert!(
        text.contains("ROC-AUC(γ_nbr)")
            && text.contains("above 1 eV/Å (%)")
            && text.contains("failed (without label)"),
        "{text}"
    );

    // A walk and its control walk start from the same structure, which has one job.
    let lost: BTreeSet<_> = lost.iter().map(|row| content(row)).collect();
    let kept: BTreeSet<_> = kept.iter().map(|row| content(row)).collect();
    let status = json(here, ["status", "strict"]);
    assert_eq!(status["labels"]["failed"], lost.len());
    assert_eq!(status["failures"][0]["class"], "implausible");
    assert_eq!(status["failures"][0]["failed"], lost.len());
    let unlabelled = status["unlabelled"].as_array().unwrap();
    let failed: u64 = unlabelled.iter().map(|part| part["failed"].as_u64().unwrap()).sum();
    assert_eq!(failed as usize, lost.len());
    assert_eq!(status["cost"]["queue"]["measured"], kept.len());
    for text in [&summary, &succeed(here, ["status", "strict"])] {
        assert!(text.contains(&format!("the labels of {} structures failed", lost.len())), "{text}");
    }
    assert!(!succeed(here, ["status", "whole"]).contains("unlabelled"));
    common::report::check(here, "strict", &status, &errors);
    compared_by_pairs(here, &errors);
    bounds_of_errors_are_told_and_written(here, &errors);
    // An unknown protocol.
    let wrong = common::refuse(here, ["force-errors", "whole", "--protocol", "nothing"]);
    assert!(wrong.contains("no protocol 'nothing'; it has 'potential'"), "{wrong}");
    // All walks have version 0 of the potential.
    for command in ["force-errors", "report"] {
        let wrong = common::refuse(here, [command, "whole", "--version", "3"]);
        assert!(
            wrong.contains("--version 3: no walk has this version") && wrong.contains("one of 0"),
            "{wrong}"
        );
    }
    assert!(errors["version"].is_null() && errors["by_version"].is_null(), "{errors}");
}

/// The comparison of the campaigns `whole` and `strict`, in which a third of the labels failed: `errors`.
fn compared_by_pairs(here: &Path, errors: &Json) {
    let whole = json(here, ["force-errors", "whole"]);
    let (whole, strict) = (&whole["biased_against_control"], &errors["biased_against_control"]);
    let number = |of: &Json, key: &str| of["pairs"]["counts"][key].as_u64().unwrap();
    let (pairs, same) = force_maes(&here.join("whole"));
    assert!(pairs.len() > 1, "{pairs:?}");
    assert_eq!((number(whole, "pairs"), number(whole, "same_structure")), (pairs.len() as u64, same as u64));
    let found = &whole["pairs"]["force_mae"];
    for (k, side) in ["biased", "control"].into_iter().enumerate() {
        let expected = median(pairs.iter().map(|pair| pair[k]).collect());
        let value = found[side]["value"].as_f64().unwrap();
        assert!((value - expected).abs() < 1e-12, "{side} {value} {expected}");
        assert!(found[side]["interval"].is_null(), "two seed structures have no intervals: {found}");
    }
    let larger = pairs.iter().filter(|[biased, control]| biased > control).count();
    assert_eq!(found["tests"]["biased_larger"].as_u64(), Some(larger as u64));
    // Every pair of the whole campaign is one of the other, with labels or without.
    let outcomes = ["pairs", "same_structure", "biased_failed", "control_failed", "both_failed"];
    let all = |of: &Json| outcomes.iter().map(|key| number(of, key)).sum::<u64>();
    assert_eq!(all(strict), all(whole), "{strict}");
    assert!(all(strict) > number(strict, "pairs") + number(strict, "same_structure"), "{strict}");
    let text = succeed(here, ["force-errors", "whole"]);
    let words = format!("{} pairs of 2 seed structures and", pairs.len());
    assert!(text.contains(&words) && text.contains("are too few for a bootstrap"), "{text}");
}

/// Bounds of the force error in the campaign `strict`, which has too few labels for one.
fn bounds_of_errors_are_told_and_written(here: &Path, errors: &Json) {
    let note = errors["calibration"]["note"].as_str().unwrap();
    let number = errors["all"]["structures"].as_u64().unwrap();
    assert!(
        note.contains("needs 20 labelled structures") && note.ends_with(&format!(": {number}")),
        "{note}"
    );
    let text = succeed(here, ["force-errors", "strict", "--calibration", "bounds.json"]);
    assert!(text.contains("bounds of the force error by γ_nbr: no bound"), "{text}");
    let file: Json = serde_json::from_str(&fs::read_to_string(here.join("bounds.json")).unwrap()).unwrap();
    assert_eq!((&file["found"], &file["version"]), (&errors["calibration"]["found"], &0.into()));
    let rows = labelled(&here.join("strict"));
    let ExportSource::Candidate { id, .. } = &rows[0].source else { panic!("an import") };
    let told = succeed(here, ["explain", "strict", id]);
    assert!(told.contains("expected     unknown for atom"), "{told}");
    let expected = &json(here, ["explain", "strict", id])["expected_errors"];
    assert!(expected["worst"]["bound"].is_null() && expected["level"] == 0.9, "{expected}");

    // The bounds belong to the grades of one model with one artifact.
    let path = |file: &str| common::config(&format!("data/al_eam_1l/{file}")).display().to_string();
    let (model, artifact) = (path("kokkos.npz"), path("gmm_artifacts.npz"));
    let score = ["calm", "score", "--model", &model, "seeds.extxyz", "-o", "graded.extxyz"];
    let with =
        |more: &[&str]| -> Vec<String> { score.iter().chain(more).map(|word| (*word).to_owned()).collect() };
    for source in ["bounds.json", "strict"] {
        let right = with(&["--artifact", &artifact, "--calibration", source, "--table", "graded.csv"]);
        let said = succeed(here, right);
        assert!(said.contains("force_error_bound from labels of protocol 'potential'"), "{said}");
        let table = fs::read_to_string(here.join("graded.csv")).unwrap();
        assert!(table.lines().next().unwrap().ends_with(",force_error_max,force_error_bound"), "{table}");
        assert!(table.lines().skip(1).all(|row| row.ends_with(',')), "{table}");
    }
    let other = fs::read_to_string(here.join("bounds.json")).unwrap().replacen(
        "\"mixture_hash\": \"",
        "\"mixture_hash\": \"0",
        1,
    );
    fs::write(here.join("other.json"), other).unwrap();
    let wrong = common::refuse(here, with(&["--artifact", &artifact, "--calibration", "other.json"]));
    assert!(wrong.contains("the artifact is another one than 0"), "{wrong}");
}

#[test]
fn labels_that_wait_have_a_price_as_soon_as_one_was_made() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let config = Small::default().write(here);
    let text = fs::read_to_string(&config).unwrap();
    fs::write(&config, text.replace("[label]", "[label]\nconcurrency = 0")).unwrap();
    let _run = common::Running(common::program(here).args(["run", "campaign.toml"]).spawn().unwrap());
    let queued = || json(here, ["status", "campaign"])["labels"]["queued"].as_u64().unwrap_or(0);
    common::processes::wait_until("all structures are collected", || {
        here.join("campaign/campaign.sqlite").exists() && queued() >= 4
    });
    let before = json(here, ["status", "campaign"]);
    assert_eq!(before["cost"]["queue"]["remaining"], Json::Null, "{before}");
    assert!(succeed(here, ["status", "campaign"]).contains("unknown before the first one"));
    // Make the labels with `calmwalk label`.
    let mut labeller = common::Running(
        common::program(here).args(["label", "--store", "campaign", "--until-empty"]).spawn().unwrap(),
    );
    assert!(labeller.0.wait().unwrap().success());
    let after = json(here, ["status", "campaign"]);
    assert!(after["cost"]["queue"]["measured"].as_u64().unwrap() > 0, "{after}");
}
