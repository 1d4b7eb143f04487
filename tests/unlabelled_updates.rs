//! `calmwalk calm build --campaign`: accepted candidates without a label update the new mixture.

use std::path::Path;

use calm::{Artifact, Grades};
use npz::NpzFile;
use store::{Fate, Store, StoredCandidate};

use crate::common::campaign::Small;
use crate::common::{config, refuse, succeed};

/// Builds a mixture of the data of the campaign's artifact, with its model. Returns what was printed.
fn build(here: &Path, output: &str, campaign: &str) -> String {
    succeed(here, arguments(output, campaign))
}

fn arguments(output: &str, campaign: &str) -> Vec<String> {
    let [model, data] =
        ["kokkos.npz", "seed_frames.extxyz"].map(|name| config(&format!("data/al_eam_1l/{name}")));
    let [model, data] = [model, data].map(|path| path.display().to_string());
    let words = ["calm", "build", "--model", &model, &data, "--candidates", "1"];
    let more = ["--output", output, "--campaign", campaign];
    words.iter().chain(&more).map(|word| (*word).to_owned()).collect()
}

/// Accepted candidates of biased walks in decision order.
fn accepted(here: &Path) -> Vec<StoredCandidate> {
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let store = Store::open_read_only(&here.join("here")).await.unwrap();
        let mut found = store.candidates(0, false, u32::MAX).await.unwrap();
        store.close().await;
        found.retain(|candidate| candidate.fate == Fate::Accepted);
        found
    })
}

/// Share of the atoms of a candidate with γ > 1. All atoms are of one element.
fn share_above(candidate: &StoredCandidate, artifact: &Path) -> f64 {
    let mixture = Artifact::load(artifact).unwrap().mixture;
    let mut grades = Grades::default();
    let elements = vec![0; candidate.selector.gamma.len()];
    grades.evaluate(&mixture, &elements, candidate.features.as_ref().unwrap(), None).unwrap();
    grades.gamma.iter().filter(|gamma| **gamma > 1.0).count() as f64 / elements.len() as f64
}

#[test]
fn walkers_do_not_find_an_excluded_structure_again() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small::default().write(here);
    succeed(here, ["run", "campaign.toml", "--directory", "here"]);
    let said = build(here, "before.npz", "here");
    assert!(said.contains(": 0 accepted candidates without a label"), "{said}");
    let before = here.join("before.npz");

    // The candidate that the new mixture covers least.
    let candidates = accepted(here);
    let share = |candidate: &&StoredCandidate| share_above(candidate, &before);
    let candidate = candidates.iter().max_by(|a, b| share(a).total_cmp(&share(b))).unwrap();
    // The campaign collects structures with a tenth of their atoms above 1.
    assert!(share(&candidate) >= 0.1);
    let id = candidate.block.view().id().to_string();
    succeed(here, ["exclude", "here", &id, "--reason", "a test"]);
    let said = build(here, "after.npz", "here");
    let expected =
        ": 1 accepted candidate without a label, of which 1 updated the mixture and 0 were covered already\n";
    assert!(said.contains(expected), "{said}");
    let after = here.join("after.npz");
    assert!(share_above(candidate, &after) < 0.1);
    let version = NpzFile::open(&after).unwrap().numbers("mixture_version").unwrap();
    assert_eq!(version.data, [1.0]);

    let message = refuse(here, arguments("x.npz", "nowhere"));
    assert!(message.contains("nowhere") && !here.join("x.npz").exists(), "{message}");
}
