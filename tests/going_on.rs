//! Continuing a campaign with another configuration: permitted changes are applied and logged, others are refused.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};
use store::Store;
use tempfile::TempDir;

use crate::common;
use crate::common::campaign::Small;
use crate::common::{calmwalk, config, refuse, stderr, succeed};

const RUN: [&str; 4] = ["run", "campaign.toml", "--directory", "here"];

fn small() -> Small {
    Small { steps: 60, ..Small::default() }
}

/// A finished campaign.
fn finished() -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    small().write(directory.path());
    succeed(directory.path(), RUN);
    directory
}

/// Replaces the first `from` in the configuration.
fn replace(directory: &Path, from: &str, to: &str) {
    let path = directory.join("campaign.toml");
    let text = fs::read_to_string(&path).unwrap();
    assert!(text.contains(from), "no {from}");
    fs::write(path, text.replacen(from, to, 1)).unwrap();
}

/// Continues the campaign. Returns the lines about changes of the configuration.
fn run_again(directory: &Path) -> String {
    let output = calmwalk(directory, RUN);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let shown = stderr(&output);
    shown.lines().filter(|line| line.starts_with("configuration: ")).collect::<Vec<_>>().join("\n")
}

/// Reads the database with `read`.
fn look<T>(directory: &Path, read: impl AsyncFnOnce(&Store) -> T) -> T {
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let store = Store::open_read_only(&directory.join("here")).await.unwrap();
        let found = read(&store).await;
        store.close().await;
        found
    })
}

/// Details of the changes in the operations log.
fn logged(directory: &Path) -> Vec<Value> {
    let operations = look(directory, async |store| store.operations(0, u32::MAX).await.unwrap());
    let changes = operations.into_iter().filter(|operation| operation.kind == "configuration");
    changes.map(|operation| operation.detail).collect()
}

/// (origin, seed structure, state, accepted) of every walk.
fn walks(directory: &Path) -> Vec<(String, String, String, u32)> {
    let status = look(directory, async |store| store.status().await.unwrap());
    let walk = |walk: store::WalkStatus| (walk.origin, walk.seed_structure, walk.state, walk.accepted);
    status.walks.into_iter().map(walk).collect()
}

#[test]
fn other_physics_is_refused_with_old_and_new_value() {
    let directory = finished();
    let here = directory.path();
    let original = fs::read_to_string(here.join("campaign.toml")).unwrap();
    let line = |of: &str| 1 + original.lines().position(|line| line.starts_with(of)).unwrap();
    let database = fs::read(here.join("here/campaign.sqlite")).unwrap();
    for (key, from, to, words) in [
        (
            "tau",
            "tau = 0.3",
            "tau = 0.4",
            "walk.tau is 0.4, but this campaign started with 0.3: a started campaign",
        ),
        (
            "rng_seed",
            "rng_seed = 7",
            "rng_seed = 8",
            "campaign.rng_seed is 8, but this campaign started with 7",
        ),
        (
            "walks_per_round",
            "round = 2",
            "round = 1",
            "run.walks_per_round is 1, but this campaign started with 2",
        ),
        (
            "mode",
            "reproducible",
            "live",
            "campaign.mode is \"live\", but this campaign started with \"reproducible\"",
        ),
        (
            "[walk]",
            "volume_ramp",
            "# volume_ramp",
            "walk.volume_ramp is left out, but this campaign started with {",
        ),
        (
            "[calm]",
            "training_frames",
            "# training_frames",
            "calm.training_frames is left out, but this campaign",
        ),
    ] {
        replace(here, from, to);
        let message = refuse(here, RUN);
        assert!(message.contains(&format!("campaign.toml:{}: ", line(key))), "{message}");
        assert!(message.contains(words), "{message}\nexpected {words}");
        assert!(
            message.contains("Restore the old value, or start another campaign with --directory"),
            "{message}"
        );
        fs::write(here.join("campaign.toml"), &original).unwrap();
    }
    assert_eq!(fs::read(here.join("here/campaign.sqlite")).unwrap(), database);
    assert_eq!(run_again(here), "");
    assert_eq!(logged(here), Vec::<Value>::new());
}

#[test]
fn files_may_move_but_not_change() {
    let directory = finished();
    let here = directory.path();
    let label = config("data/Al_mm.eam.fs").display().to_string();
    let content = fs::read_to_string(&label).unwrap();
    fs::write(here.join("label.eam.fs"), &content).unwrap();
    replace(here, &label, "label.eam.fs");
    assert_eq!(run_again(here), "");
    fs::write(here.join("label.eam.fs"), format!("another comment{content}")).unwrap();
    let message = refuse(here, RUN);
    assert!(
        message.contains("label.method.potential.file: the contents of the file changed (BLAKE3 "),
        "{message}"
    );
    assert!(message.contains("Restore the old file"), "{message}");
}

#[test]
fn budgets_walkers_and_slots_are_applied_printed_and_logged() {
    let directory = finished();
    let here = directory.path();
    let before = walks(here);
    assert!(before.iter().all(|walk| walk.0 == "control" || walk.2 == "completed"), "{before:?}");
    replace(here, "max_per_walk = 4", "max_per_walk = 6\nmax_structures = 20");
    replace(here, "walkers = 2", "walkers = 1");
    replace(here, "[label]", "[label]\nconcurrency = 2");
    let shown = "configuration: collect.max_per_walk is now 6 (was 4)\n\
                 configuration: collect.max_structures is now 20 (was left out)\n\
                 configuration: label.concurrency is now 2 (was 1)\n\
                 configuration: run.walkers is now 1 (was 2)";
    assert_eq!(run_again(here), shown);
    let change =
        |key: &str, before: Value, after: Value| json!({ "key": key, "before": before, "after": after });
    let expected = [
        change("collect.max_per_walk", 4.into(), 6.into()),
        change("collect.max_structures", Value::Null, 20.into()),
        change("label.concurrency", 1.into(), 2.into()),
        change("run.walkers", 2.into(), 1.into()),
    ];
    assert_eq!(logged(here), expected);
    assert_eq!(run_again(here), "", "the new values are those of the campaign now");
    assert_eq!(walks(here), before, "walks that have made all their steps stay ended");
}

#[test]
fn a_larger_budget_lets_walks_continue() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small::default().write(here);
    replace(here, "max_per_walk = 4", "max_per_walk = 1");
    succeed(here, RUN);
    let accepted = || -> Vec<_> {
        let biased = walks(here).into_iter().filter(|walk| walk.0 == "biased");
        biased.map(|(_, name, state, accepted)| (name, state, accepted)).collect()
    };
    let collected =
        |accepted: u32| ["fcc-100", "vacancy"].map(|n| (n.to_owned(), "quota_reached".to_owned(), accepted));
    assert_eq!(accepted(), collected(1));
    replace(here, "max_per_walk = 1", "max_per_walk = 2");
    assert_eq!(run_again(here), "configuration: collect.max_per_walk is now 2 (was 1)");
    assert_eq!(accepted(), collected(2));
    // One more structure in total: the first walk that finds one collects it.
    replace(here, "max_per_walk = 2", "max_per_walk = 4\nmax_structures = 5");
    run_again(here);
    assert_eq!(accepted().iter().map(|walk| walk.2).sum::<u32>(), 5);
}

#[test]
fn added_seed_structures_are_walked() {
    let directory = finished();
    let here = directory.path();
    let before = walks(here);
    // Append a frame to the file …
    Small { seed_structures: &["fcc-100", "vacancy", "fcc-097"], ..small() }.write(here);
    let shown = run_again(here);
    assert!(
        shown.starts_with("configuration: seed structures added to the existing 2: 'fcc-097'"),
        "{shown}"
    );
    let walked = walks(here);
    assert_eq!(walked[..before.len()], before);
    assert!(
        walked[before.len()..].iter().any(|walk| walk.0 == "biased" && walk.1 == "fcc-097"),
        "{walked:?}"
    );
    // … and then another file.
    let frames = atoms::read_extxyz(&config("data/aluminium_seeds.extxyz")).unwrap();
    let frame = frames.into_iter().find(|frame| frame.info["name"].text() == Some("fcc-103")).unwrap();
    common::write_frames(&here.join("more.extxyz"), &[frame]);
    replace(here, "[\"seeds.extxyz\"]", "[\"seeds.extxyz\", \"more.extxyz\"]");
    assert!(run_again(here).contains("'fcc-103'"));
    let walked = walks(here);
    assert!(walked.iter().all(|walk| !["waiting", "running"].contains(&walk.2.as_str())), "{walked:?}");
    assert!(walked.iter().any(|walk| walk.0 == "biased" && walk.1 == "fcc-103"), "{walked:?}");
    let logged = logged(here);
    assert_eq!((&logged[0]["before"], &logged[0]["after"]), (&2.into(), &3.into()), "{logged:?}");
    assert!(logged[1]["added"][0].as_str().unwrap().starts_with("fcc-103 "), "{logged:?}");
}

#[test]
fn seed_structures_cannot_be_changed_moved_or_taken_away() {
    let directory = finished();
    let here = directory.path();
    let moved = Small { seed_structures: &["vacancy", "fcc-100"], ..small() };
    let fewer = Small { seed_structures: &["fcc-100"], ..small() };
    for (other, words) in [
        (moved, "seed structure 0 is 'vacancy' (content "),
        (fewer, "seed structure 1 is missing, but this campaign has 'vacancy' (content "),
    ] {
        other.write(here);
        let message = refuse(here, RUN);
        assert!(message.contains("seed_structures.files: ") && message.contains(words), "{message}");
        assert!(message.contains("append new seed structures after the existing ones"), "{message}");
    }
    small().write(here);
    let path = here.join("seeds.extxyz");
    let mut frames = atoms::read_extxyz(&path).unwrap();
    frames[1].structure.positions[0][0] += 0.01;
    common::write_frames(&path, &frames);
    let message = refuse(here, RUN);
    assert!(message.contains("seed structure 1 is 'vacancy' (content "), "{message}");
    small().write(here);
    assert_eq!(run_again(here), "");
}

#[test]
fn precision_is_part_of_what_a_campaign_is() {
    let directory = finished();
    let here = directory.path();
    let before = look(here, async |store| store.decision_log_text().await.unwrap());
    replace(here, "[potential]\n", "[potential]\nprecision = \"double\"\n");
    assert_eq!(run_again(here), "");
    replace(here, "\"double\"", "\"mixed\"");
    let message = refuse(here, RUN);
    assert!(
        message.contains("campaign.toml:") && message.contains("potential.precision is \"mixed\""),
        "{message}"
    );

    // A campaign in mixed precision gives the same decisions with separate processes and in a single process.
    let [processes, together] = [&[][..], &["--in-process"]].map(|options| {
        let directory = tempfile::tempdir().unwrap();
        small().write(directory.path());
        replace(directory.path(), "[potential]\n", "[potential]\nprecision = \"mixed\"\n");
        succeed(directory.path(), RUN.iter().chain(options).copied());
        directory
    });
    let decisions =
        |directory: &TempDir| look(directory.path(), async |store| store.decision_log_text().await.unwrap());
    assert!(decisions(&processes).contains("accepted"));
    assert_eq!(decisions(&processes), decisions(&together));
    assert_ne!(decisions(&processes), before);
    replace(processes.path(), "\"mixed\"", "\"double\"");
    let message = refuse(processes.path(), RUN);
    assert!(
        message.contains("potential.precision is left out, but this campaign started with \"mixed\""),
        "{message}"
    );
}
