//! `calmwalk calm export`: the mixture of a campaign at any version, as files.

use std::fs;
use std::path::Path;
use std::process::Stdio;

use calm::{Artifact, Component, Grades};
use npz::NpzFile;
use serde_json::Value;
use store::{Fate, Store, StoredCandidate};
use tempfile::TempDir;

use crate::common::campaign::Small;
use crate::common::processes::wait_until;
use crate::common::{Running, config, deviation, program, refuse, succeed};

const RUN: [&str; 4] = ["run", "campaign.toml", "--directory", "here"];

/// A finished campaign, in whose configuration `from` was replaced.
fn finished(small: &Small, from: &str, to: &str) -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    let path = small.write(directory.path());
    let text = fs::read_to_string(&path).unwrap();
    assert!(text.contains(from));
    fs::write(&path, text.replacen(from, to, 1)).unwrap();
    succeed(directory.path(), RUN);
    directory
}

fn export(here: &Path, version: u64) -> String {
    let output = format!("{version}.npz");
    succeed(here, ["calm", "export", "here", "--version", &version.to_string(), "--output", &output])
}

fn newest(here: &Path) -> u64 {
    let status = succeed(here, ["status", "here", "--json"]);
    serde_json::from_str::<Value>(&status).unwrap()["mixture_version"].as_u64().unwrap()
}

fn look<T>(here: &Path, read: impl AsyncFnOnce(&Store) -> T) -> T {
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let store = Store::open_read_only(&here.join("here")).await.unwrap();
        let found = read(&store).await;
        store.close().await;
        found
    })
}

/// Version of the mixture after each decision.
fn versions(here: &Path) -> Vec<(String, u64)> {
    let decisions = look(here, async |store| store.decisions(1..=i64::MAX).await.unwrap());
    decisions.into_iter().map(|decision| (decision.kind, decision.mixture_version)).collect()
}

fn single(values: &[f64]) -> Vec<f64> {
    values.iter().map(|&value| f64::from(value as f32)).collect()
}

/// Compares the exported newest version with the store, rounded to single precision.
fn check_newest(here: &Path, artifact: &Path) {
    let found = Artifact::load(artifact).unwrap();
    let stored = look(here, async |store| store.load_components().await.unwrap());
    assert!(!stored.is_empty());
    for record in stored {
        let expected = Component::from_bytes(&record.bytes).unwrap();
        let found = found.mixture.component(record.element as usize, record.slot as usize).unwrap();
        assert_eq!((found.centroid(), found.threshold()), (expected.centroid(), expected.threshold()));
        assert_eq!(found.inverse(), single(expected.inverse()));
        let [found, expected] = [found, &expected].map(|component| component.statistics().unwrap());
        assert_eq!(found.scatter, single(&expected.scatter));
        assert_eq!((found.count, found.effective_count), (expected.count, expected.effective_count));
    }
}

/// Deviation between the selector's grades of a candidate and grades by the exported file. All atoms are of one element.
fn deviation_of_grades(candidate: &StoredCandidate, artifact: &Path) -> f64 {
    let mixture = Artifact::load(artifact).unwrap().mixture;
    let mut grades = Grades::default();
    let elements = vec![0; candidate.selector.gamma.len()];
    grades.evaluate(&mixture, &elements, candidate.features.as_ref().unwrap(), None).unwrap();
    deviation(&grades.gamma, &candidate.selector.gamma)
}

#[test]
fn every_version_grades_as_the_selector_did() {
    let directory = finished(&Small::default(), "[run]", "[run]");
    let here = directory.path();
    let database = fs::read(here.join("here/campaign.sqlite")).unwrap();
    let newest = newest(here);
    assert!(newest > 2);
    let said = succeed(here, ["calm", "export", "here", "--output", "newest.npz", "--embed", "model.npz"]);
    let expected = format!(
        "mixture version {newest} of 0 to {newest}: 1 of 1 component changed\nwrote newest.npz\nwrote model.npz\n"
    );
    assert_eq!(said, expected);
    check_newest(here, &here.join("newest.npz"));

    // An accepted candidate was graded by the version before its own.
    let candidates = look(here, async |store| store.candidates(0, false, u32::MAX).await.unwrap());
    let accepted: Vec<_> = candidates.iter().filter(|candidate| candidate.fate == Fate::Accepted).collect();
    assert_eq!(accepted.len() as u64, newest);
    for (version, candidate) in (0..newest).zip(accepted) {
        export(here, version);
        let found = deviation_of_grades(candidate, &here.join(format!("{version}.npz")));
        // Directions that the training data do not span have the variance 10⁻⁶, and single precision resolves the inverses
        // only relative to them.
        assert!(found < 1e-3, "version {version}: {found}");
        assert!(deviation_of_grades(candidate, &here.join("newest.npz")) > 1e-2);
    }
    export(here, newest);
    assert_eq!(
        fs::read(here.join(format!("{newest}.npz"))).unwrap(),
        fs::read(here.join("newest.npz")).unwrap()
    );

    let original = config("data/al_eam_1l/gmm_artifacts.npz");
    let [original, first] = [&original, &here.join("0.npz")].map(|path| NpzFile::open(path).unwrap());
    let text = ["element_map", "threshold_mode", "uq_feature_mode"];
    for name in original.names() {
        match text.contains(&name) {
            true => assert_eq!(first.strings(name).unwrap(), original.strings(name).unwrap()),
            false => {
                assert_eq!(first.numbers(name).unwrap().data, original.numbers(name).unwrap().data, "{name}")
            }
        }
    }

    // The model with the embedded mixture gives bitwise the same grades as the artifact.
    let model = config("data/al_eam_1l/kokkos.npz").display().to_string();
    let score = |model: &str, options: &[&str], output: &str| {
        let words = ["calm", "score", "--model", model, "seeds.extxyz", "--output", output];
        succeed(here, words.iter().chain(options));
        fs::read(here.join(output)).unwrap()
    };
    let by_artifact = score(&model, &["--artifact", "newest.npz"], "a.extxyz");
    assert!(by_artifact == score("model.npz", &[], "b.extxyz"));
    assert!(by_artifact != score(&model, &[], "c.extxyz"));
    assert_eq!(fs::read(here.join("here/campaign.sqlite")).unwrap(), database, "nothing is written");
}

#[test]
fn a_mixture_that_was_replaced_by_the_original_is_found() {
    let small = Small { walks_per_round: 1, steps: 120, ..Small::default() };
    let directory =
        finished(&small, "[seed_structures]", "update = \"per_seed_structure\"\n[seed_structures]");
    let here = directory.path();
    let versions = versions(here);
    let restart = versions.windows(2).find(|pair| pair[1].0 == "ended" && pair[1].1 > pair[0].1).unwrap();
    assert_eq!(restart[0].1 + 1, restart[1].1);
    assert!(export(here, restart[0].1).contains("1 of 1 component changed"));
    assert!(export(here, restart[1].1).contains("0 of 1 component changed"));
}

#[test]
fn a_running_campaign_is_exported() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small { steps: 100_000, max_per_walk: 1000, ..Small::default() }.write(here);
    let mut command = program(here);
    let child = command.args(RUN).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let running = Running(child);
    let database = here.join("here/campaign.sqlite");
    wait_until("there are two versions", || database.exists() && newest_or_zero(here) >= 2);
    let said = succeed(here, ["calm", "export", "here", "--output", "newest.npz"]);
    assert!(export(here, 1).contains("mixture version 1 of 0 to "), "{said}");
    assert!(Artifact::load(here.join("newest.npz")).is_ok());
    drop(running);
}

fn newest_or_zero(here: &Path) -> u64 {
    let output = crate::common::calmwalk(here, ["status", "here", "--json"]);
    serde_json::from_slice::<Value>(&output.stdout).unwrap_or_default()["mixture_version"]
        .as_u64()
        .unwrap_or(0)
}

/// Declined candidates do not change the mixture.
#[test]
fn no_version_needs_features_of_declined_candidates() {
    let seed_structures = &["fcc-100", "fcc-097", "fcc-103", "vacancy"];
    let small = Small { walks_per_round: 4, seed_structures, ..Small::default() };
    let directory = finished(&small, "[run]", "[run]");
    let here = directory.path();
    let versions = [1, newest(here) - 1];
    let exports = || {
        versions.map(|version| {
            export(here, version);
            fs::read(here.join(format!("{version}.npz"))).unwrap()
        })
    };
    let before = exports();
    assert!(before[0] != before[1]);
    succeed(here, ["store", "compact", "here", "--drop-declined-features"]);
    let candidates = look(here, async |store| store.candidates(0, false, u32::MAX).await.unwrap());
    let accepted = candidates.iter().rposition(|candidate| candidate.fate == Fate::Accepted).unwrap();
    assert!(candidates[..accepted].iter().any(|candidate| candidate.features.is_none()));
    assert!(exports() == before);
}

#[test]
fn what_cannot_be_exported_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let path = Small::default().write(here);
    let artifact = config("data/al_eam_1l/gmm_artifacts.npz");
    fs::copy(&artifact, here.join("calm.npz")).unwrap();
    let text = fs::read_to_string(&path).unwrap().replace(artifact.to_str().unwrap(), "calm.npz");
    fs::write(&path, text).unwrap();
    succeed(here, RUN);
    let newest = newest(here);
    let refused = |words: &[&str]| {
        let message = refuse(here, ["calm", "export", "here"].iter().chain(words));
        assert!(!here.join("x.npz").exists());
        message
    };
    let message = refused(&["--version", "999", "--output", "x.npz"]);
    assert!(message.contains(&format!("versions 0 to {newest} so far")), "{message}");
    let message = refused(&["--output", "calm.npz"]);
    assert!(message.contains("calm.npz is the artifact of the campaign"), "{message}");
    let message = refused(&["--output", "x.npz", "--embed", "x.npz"]);
    assert!(message.contains("x.npz and x.npz: one file is named for two outputs"), "{message}");
    let model = config("data/al_eam_1l/kokkos.npz").display().to_string();
    let message = refused(&["--output", "x.npz", "--embed", &model]);
    assert!(message.contains("is the model of the campaign"), "{message}");
    fs::copy(config("data/al_eam_1l/kokkos.npz"), here.join("calm.npz")).unwrap();
    let message = refused(&["--output", "x.npz"]);
    assert!(message.contains("calm.artifact: ") && message.contains("has another content"), "{message}");
    let moved = ["--output", "x.npz", "--artifact", artifact.to_str().unwrap()];
    succeed(here, ["calm", "export", "here"].iter().chain(&moved));
    assert!(here.join("x.npz").exists());
}
