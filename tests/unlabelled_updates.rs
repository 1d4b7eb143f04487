//! `calmwalk calm build --campaign`: accepted candidates without a label update the new mixture.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use atoms::{Cell, NeighbourList, Structure};
use calm::{Artifact, CollectionRule, CovarianceUpdateKind, Grades, Mixture, UpdateSettings};
use npz::NpzFile;
use potentials::grace::{Grace, GraceModel};
use serde_json::json;
use store::{CampaignRecord, Commit, Decision, Fate, Label, Location, Protocol, Store, StoredCandidate};
use wire::{CampaignId, ContentHash, WalkId};

use crate::common::campaign::Small;
use crate::common::label_campaign::{on_store, queue};
use crate::common::{calmwalk, config, refuse, stderr, succeed, write_frames};

const PROTOCOL: ContentHash = ContentHash([1; 32]);

fn model() -> String {
    config("data/al_eam_1l/kokkos.npz").display().to_string()
}

/// The arguments of a build of `data` with one component.
fn arguments(output: &str, data: &str, more: &[&str]) -> Vec<String> {
    let model = model();
    let words = ["calm", "build", "--model", &model, data, "--candidates", "1", "--output", output];
    words.iter().chain(more).map(|word| (*word).to_owned()).collect()
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
    let data = config("data/al_eam_1l/seed_frames.extxyz").display().to_string();
    let build = |output: &str| succeed(here, arguments(output, &data, &["--campaign", "here"]));
    let said = build("before.npz");
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
    let said = build("after.npz");
    let expected =
        ": 1 accepted candidate without a label, of which 1 updated the mixture and 0 were covered already\n";
    assert!(said.contains(expected), "{said}");
    let after = here.join("after.npz");
    assert!(share_above(candidate, &after) < 0.1);
    assert_eq!(version(&after), 1.0);
}

/// Writes four frames of the model's training data, of 108 atoms each. Returns the first.
fn write_data(here: &Path) -> Structure {
    let mut frames = atoms::read_extxyz(&config("data/al_eam_1l/seed_frames.extxyz")).unwrap();
    frames.truncate(4);
    write_frames(&here.join("data.extxyz"), &frames);
    frames.swap_remove(0).structure
}

/// The structure with all lengths multiplied by `factor`.
fn scaled(structure: &Structure, factor: f64) -> Structure {
    let scaled = |vector: &[f64; 3]| vector.map(|x| factor * x);
    let cell = Cell(structure.cell.0.map(|vector| scaled(&vector)));
    Structure { positions: structure.positions.iter().map(scaled).collect(), cell, ..structure.clone() }
}

/// Writes a campaign with this configuration that has accepted these structures in this order, without their features. None has a
/// label. Returns the names of the candidates.
fn write_campaign(directory: &Path, configuration: &str, structures: &[&Structure]) -> Vec<String> {
    fs::create_dir(directory).unwrap();
    let record = CampaignRecord {
        id: CampaignId([1; 16]),
        program_version: "0.1.0".into(),
        mode: "reproducible".into(),
        configuration: configuration.into(),
        resolved_configuration: "{}".into(),
        configuration_in_force: "{}".into(),
    };
    let protocol = Protocol { hash: PROTOCOL, name: "potential".into(), settings: json!({}) };
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let store = Store::create(directory, &record, &[], 0).await.unwrap();
        store.add_protocol(&protocol, 0).await.unwrap();
        store.close().await;
    });
    add(directory, 1, structures)
}

/// Adds accepted candidates of a walk from this step on, one at each step.
fn add(directory: &Path, first: u64, structures: &[&Structure]) -> Vec<String> {
    let add = |(step, structure): (u64, &&Structure)| {
        queue(Location::from(directory), step, (*structure).clone(), Vec::new())
    };
    (first..).zip(structures).map(add).collect()
}

/// The mixture of an artifact after updates by these structures in this order, with the rules of [`Small`].
fn by_hand(artifact: &Path, kind: CovarianceUpdateKind, structures: &[&Structure]) -> Mixture {
    let model = Arc::new(GraceModel::load(Path::new(&model())).unwrap());
    let mut neighbours = NeighbourList::new(model.cutoff(), 0.0);
    let mut grace = Grace::new(Arc::clone(&model));
    let rule = "rule = 'atom_count'\nthreshold = 1.0\nfraction = 0.1\n";
    let criterion: CollectionRule = toml::from_str(rule).unwrap();
    let stop = toml::from_str(&format!("{rule}target = 1.25")).unwrap();
    let settings = UpdateSettings { covariance_update: kind, alpha_values: None, stop };
    let (mut mixture, mut grades) = (Artifact::load(artifact).unwrap().mixture, Grades::default());
    for structure in structures {
        let elements = model.element_indices(&structure.species).unwrap();
        neighbours.update(structure).unwrap();
        grace.forward(structure, &neighbours).unwrap();
        grades.evaluate(&mixture, &elements, grace.features(), None).unwrap();
        if criterion.is_met(&grades.gamma) {
            let outcome = calm::update(&mixture, &elements, grace.features(), &settings).unwrap();
            mixture = mixture.with_changes(&outcome.changed).unwrap();
        }
    }
    mixture
}

fn version(artifact: &Path) -> f64 {
    NpzFile::open(artifact).unwrap().numbers("mixture_version").unwrap().data[0]
}

/// Inverse covariance and scatter of the only component, in single precision.
fn numbers(mixture: &Mixture) -> [Vec<f32>; 2] {
    let component = mixture.component(0, 0).unwrap();
    [component.inverse(), &component.statistics().unwrap().scatter]
        .map(|numbers| numbers.iter().map(|x| *x as f32).collect())
}

/// Whether an artifact has this mixture, at this version.
fn is_same(artifact: &Path, expected: &Mixture) -> bool {
    let found = Artifact::load(artifact).unwrap().mixture;
    version(artifact) == expected.version() as f64 && numbers(&found) == numbers(expected)
}

#[test]
fn candidates_update_in_the_order_of_their_decisions() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let first = write_data(here);
    let (large, small) = (scaled(&first, 1.12), scaled(&first, 0.9));
    let text = Small::default().text();
    write_campaign(&here.join("forward"), &text, &[&large, &small]);
    write_campaign(&here.join("backward"), &text, &[&small, &large]);
    succeed(here, arguments("before.npz", "data.extxyz", &[]));
    let build = |campaign: &str| {
        let output = format!("{campaign}.npz");
        let said = succeed(here, arguments(&output, "data.extxyz", &["--campaign", campaign]));
        let expected = ": 2 accepted candidates without a label, of which 2 updated the mixture and 0 were covered already\n";
        assert!(said.contains(expected), "{said}");
        here.join(output)
    };
    let [forward, backward] = ["forward", "backward"].map(build);
    let by_hand = |structures: &[&Structure]| {
        by_hand(&here.join("before.npz"), CovarianceUpdateKind::Convex, structures)
    };
    let expected = [by_hand(&[&large, &small]), by_hand(&[&small, &large])];
    assert!(is_same(&forward, &expected[0]) && is_same(&backward, &expected[1]));
    assert!(numbers(&expected[0]) != numbers(&expected[1]));
}

#[test]
fn pending_and_failed_labels_are_none() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let first = write_data(here);
    let [labelled, failed, leased, queued] = [0.95, 1.12, 0.9, 0.901].map(|factor| scaled(&first, factor));
    let mut copper = first;
    copper.species.fill("Cu".parse().unwrap());
    // The campaign had another model.
    let text = Small::default().text().replace("al_eam_1l/kokkos.npz", "earlier.npz");
    let names =
        write_campaign(&here.join("campaign"), &text, &[&labelled, &failed, &leased, &queued, &copper]);
    on_store(Location::from(here.join("campaign")), async |store| {
        let lease = async || store.lease(PROTOCOL, "host/a", 0, 600).await.unwrap().unwrap();
        let (first, second, third) = (lease().await, lease().await, lease().await);
        let forces = vec![[0.0; 3]; labelled.len()];
        let label = Label { energy: -1.0, forces, stress: None, details: Default::default() };
        store.complete(&first, &label, 1).await.unwrap();
        store.fail(&second, "crashed", "", 1, 1).await.unwrap();
        assert_eq!([first.candidate, second.candidate, third.candidate], names[..3]);
    });
    succeed(here, arguments("before.npz", "data.extxyz", &[]));
    let output = calmwalk(here, arguments("after.npz", "data.extxyz", &["--campaign", "campaign"]));
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let said = String::from_utf8(output.stdout.clone()).unwrap();
    let expected = ": 4 accepted candidates without a label, of which 2 updated the mixture, 1 was covered already and 1 was left out \
                    (see the warnings)\n";
    assert!(said.contains(expected), "{said}");
    let warning = format!("candidate {} is left out: ", names[4]);
    let said = stderr(&output);
    assert!(said.contains(&warning) && said.contains("Cu"), "{said}");
    let expected =
        by_hand(&here.join("before.npz"), CovarianceUpdateKind::Convex, &[&failed, &leased, &queued]);
    assert!(is_same(&here.join("after.npz"), &expected));
}

#[test]
fn updates_are_additive_if_the_campaign_has_switched_to_them() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let first = write_data(here);
    let (large, small) = (scaled(&first, 1.12), scaled(&first, 0.9));
    let campaign = here.join("campaign");
    write_campaign(&campaign, &Small::default().text(), &[&large]);
    let switch = Decision {
        round: 0,
        kind: "forgetting",
        walk: Some(WalkId(0)),
        candidate: None,
        mixture_version: 0,
        detail: json!({ "covariance_update": "additive" }),
    };
    let values = vec![("additive_updates".to_owned(), "1".to_owned())];
    let commit = Commit { decisions: vec![switch], values, ..Commit::default() };
    on_store(Location::from(&campaign), async |store| store.commit(&commit).await.unwrap());
    add(&campaign, 2, &[&small]);
    succeed(here, arguments("before.npz", "data.extxyz", &[]));
    let said = succeed(here, arguments("after.npz", "data.extxyz", &["--campaign", "campaign"]));
    assert!(said.contains("of which 2 updated the mixture"), "{said}");
    let is_same =
        |kind| is_same(&here.join("after.npz"), &by_hand(&here.join("before.npz"), kind, &[&large, &small]));
    assert!(is_same(CovarianceUpdateKind::Additive) && !is_same(CovarianceUpdateKind::Convex));
}

#[test]
fn merged_parts_have_the_bytes_of_a_build_and_the_model_has_the_updated_mixture() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let first = write_data(here);
    let structures = [1.12, 0.9].map(|factor| scaled(&first, factor));
    write_campaign(&here.join("campaign"), &Small::default().text(), &[&structures[0], &structures[1]]);
    let updated = ["--campaign", "campaign", "--embed", "model.npz"];
    let printed = succeed(here, arguments("whole.npz", "data.extxyz", &updated));
    let read = |name: &str| fs::read(here.join(name)).unwrap();
    let embedded = read("model.npz");
    fs::remove_file(here.join("model.npz")).unwrap();

    let model = model();
    for pass in ["1", "2", "3"] {
        succeed(here, arguments("parts.npz", "data.extxyz", &["--pass", pass, "--part", "1/1"]));
        let merge = ["calm", "merge", "--model", &model, "--output", "parts.npz"];
        let more = if pass == "3" { &updated[..] } else { &[] };
        let said = succeed(here, merge.iter().chain(more));
        assert!(pass != "3" || said == printed.replace("whole.npz", "parts.npz"), "{said}");
    }
    assert!(read("parts.npz") == read("whole.npz") && read("model.npz") == embedded);

    // LAMMPS and calmwalk grade by the model as by the artifact, and no longer as before the updates.
    succeed(here, arguments("before.npz", "data.extxyz", &[]));
    let score = |model: &str, artifact: &[&str]| {
        let words = ["calm", "score", "--model", model, "data.extxyz", "--output", "scored.extxyz"];
        succeed(here, words.iter().chain(artifact));
        read("scored.extxyz")
    };
    let by_model = score("model.npz", &[]);
    assert!(by_model == score(&model, &["--artifact", "whole.npz"]));
    assert!(by_model != score(&model, &["--artifact", "before.npz"]));
}

#[test]
fn campaigns_that_cannot_update_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let first = write_data(here);
    let text = Small::default().text().replace("[calm]", "[calm]\nupdate = \"never\"");
    write_campaign(&here.join("fixed"), &text, &[&first]);
    for (campaign, expected) in [
        ("nowhere", "nowhere"),
        ("fixed", "never updates its mixture (calm.update = \"never\"); expected one that does"),
    ] {
        let campaign = ["--campaign", campaign];
        let model = model();
        let merge = ["calm", "merge", "--model", &model, "--output", "x.npz"];
        let merge = merge.iter().chain(&campaign).map(|word| (*word).to_owned()).collect();
        for words in [arguments("x.npz", "data.extxyz", &campaign), merge] {
            let message = refuse(here, &words);
            assert!(message.contains(expected) && !here.join("x.npz").exists(), "{words:?}: {message}");
        }
    }
}
