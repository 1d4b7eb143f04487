//! `calmwalk replay`: the same rules give the same decisions, other rules give others, and errors state where a replay cannot
//! continue.

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Connection};
use store::Store;
use tempfile::TempDir;

use crate::common::campaign::Small;
use crate::common::{calmwalk, config, refuse, stderr, succeed};

const RUN: [&str; 4] = ["run", "campaign.toml", "--directory", "here"];

/// A finished campaign with these changes to its configuration.
fn finished(small: &Small, changes: &[(&str, &str)]) -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    let path = small.write(directory.path());
    change(&path, changes);
    succeed(directory.path(), RUN);
    directory
}

/// Concurrent walks from similar structures: a structure found by one of them is often covered for the others.
fn many() -> Small {
    Small {
        walks_per_round: 4,
        seed_structures: &["fcc-100", "fcc-097", "fcc-103", "vacancy"],
        ..Small::default()
    }
}

fn change(path: &Path, changes: &[(&str, &str)]) {
    let mut text = fs::read_to_string(path).unwrap();
    for (from, to) in changes {
        assert!(text.contains(from), "no {from}");
        text = text.replacen(from, to, 1);
    }
    fs::write(path, text).unwrap();
}

fn replayed(directory: &Path, settings: &[&str]) -> Value {
    let options = settings.iter().flat_map(|setting| ["--set", setting]);
    let text = succeed(directory, ["replay", "here", "--json"].into_iter().chain(options));
    serde_json::from_str(&text).unwrap()
}

/// Checks that the replay reproduces everything, and agrees with `status`.
fn check_exact(directory: &Path) -> Value {
    let report = replayed(directory, &[]);
    assert_eq!((&report["difference"], &report["same_mixture"]), (&Value::Null, &true.into()), "{report}");
    assert_eq!((&report["before"], &report["replayed"]), (&report["now"], &report["recorded"]));
    let status: Value = serde_json::from_str(&succeed(directory, ["status", "here", "--json"])).unwrap();
    let accepted = report["now"]["accepted"].as_u64().unwrap();
    assert_eq!(status["candidates"]["accepted"], accepted);
    assert_eq!(status["candidates"]["seen"], report["now"]["candidates"]);
    assert_eq!(status["mixture_version"], report["now"]["mixture_version"]);
    assert_eq!(status["staleness"]["decisions"], report["now"]["candidates"]);
    assert!(accepted > 0);
    report
}

fn execute(directory: &Path, statements: &[&str]) {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let options = SqliteConnectOptions::new().filename(directory.join("here/campaign.sqlite"));
        let mut connection = options.foreign_keys(false).connect().await.unwrap();
        for statement in statements {
            let done =
                sqlx::query(sqlx::AssertSqlSafe((*statement).to_owned())).execute(&mut connection).await;
            assert!(done.unwrap().rows_affected() > 0, "{statement}");
        }
        connection.close().await.unwrap();
    });
}

/// Exports the labelled structures, so that another campaign can import them.
fn export(directory: &Path) -> PathBuf {
    let path = directory.join("labelled.extxyz");
    succeed(directory, ["export", "here", "--output", path.to_str().unwrap()]);
    path
}

#[test]
fn a_reproducible_campaign_is_reproduced_and_other_rules_decide_otherwise() {
    let directory = finished(&many(), &[]);
    let here = directory.path();
    let database = fs::read(here.join("here/campaign.sqlite")).unwrap();
    let report = check_exact(here);
    assert!(!report["now"]["declined"].as_object().unwrap().is_empty(), "a campaign with declines: {report}");
    let shown = succeed(here, ["replay", "here"]);
    assert!(shown.contains("all reproduced bit by bit"), "{shown}");
    assert!(shown.contains("is identical to the stored one"), "{shown}");

    let strict =
        replayed(here, &["collect.criterion={ rule = \"atom_count\", threshold = 1.2, fraction = 0.1 }"]);
    let accepted = |report: &Value, when: &str| report[when]["accepted"].as_u64().unwrap();
    assert_eq!(accepted(&strict, "before"), accepted(&report, "before"));
    assert!(accepted(&strict, "now") < accepted(&strict, "before"), "{strict}");
    let lost = strict["no_longer_accepted"].as_array().unwrap();
    let won = strict["newly_accepted"].as_array().unwrap();
    assert_eq!(accepted(&strict, "before") - lost.len() as u64 + won.len() as u64, accepted(&strict, "now"));
    assert!(lost.iter().any(|change| change["reason"] == "covered"), "{lost:?}");
    assert!(lost.iter().all(|change| change["step"].as_u64() > Some(20)), "{lost:?}");
    // A value can be set as a whole table or by its inner key.
    let inside = replayed(here, &["collect.criterion.threshold=1.2"]);
    assert_eq!(
        (&inside["now"], &inside["set"]["collect.criterion.threshold"]),
        (&strict["now"], &"1.2".into())
    );

    let one = replayed(here, &["collect.max_per_walk=1"]);
    assert_eq!(accepted(&one, "now"), 4, "{one}");
    let over = one["no_longer_accepted"].as_array().unwrap();
    assert!(over.iter().all(|change| change["reason"] == "walk over"), "{over:?}");
    let other = replayed(here, &["calm.update=never", "collect.max_per_walk=100"]);
    assert_eq!(other["now"]["mixture_version"], 0);
    let other = replayed(here, &["calm.covariance_update=additive"]);
    assert_eq!(other["difference"], Value::Null);
    assert_eq!(fs::read(here.join("here/campaign.sqlite")).unwrap(), database, "nothing is written");
}

#[test]
fn a_live_campaign_that_continued_with_other_limits_is_reproduced() {
    let live = Small { mode: "live", ..Small::default() };
    let directory = finished(&live, &[("max_per_walk = 4", "max_per_walk = 1")]);
    let here = directory.path();
    check_exact(here);
    // Import structures of another campaign: own structures that the walks find again would be duplicates.
    let other = finished(&Small { steps: 120, ..Small::default() }, &[]);
    let labelled = export(other.path());
    succeed(here, ["import", "here", labelled.to_str().unwrap()]);
    change(&here.join("campaign.toml"), &[("max_per_walk = 1", "max_per_walk = 3\nmax_structures = 5")]);
    succeed(here, RUN);
    check_exact(here);
    let kinds = kinds(here);
    for kind in ["imported", "configuration", "resumed", "control"] {
        assert!(kinds.iter().any(|found| found == kind), "{kinds:?}");
    }
}

fn kinds(directory: &Path) -> Vec<String> {
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let store = Store::open_read_only(&directory.join("here")).await.unwrap();
        let decisions = store.decisions(1..=i64::MAX).await.unwrap();
        decisions.into_iter().map(|decision| decision.kind).collect()
    })
}

#[test]
fn a_mixture_that_is_reset_is_reproduced() {
    let small = Small { walks_per_round: 1, ..Small::default() };
    let directory =
        finished(&small, &[("[seed_structures]", "update = \"per_seed_structure\"\n[seed_structures]")]);
    let report = check_exact(directory.path());
    let carried = replayed(directory.path(), &["calm.update=cumulative"]);
    let versions = |report: &Value| report["now"]["mixture_version"].as_u64().unwrap();
    assert!(versions(&carried) < versions(&report), "no version for a reset: {carried}");
}

#[test]
fn it_says_from_where_on_features_are_missing() {
    let directory = finished(&many(), &[("max_per_walk = 4", "max_per_walk = 4\ndeclined_features_mb = 0")]);
    let here = directory.path();
    let report = replayed(here, &[]);
    let stopped = &report["stopped"];
    assert_eq!(report["replayed"].as_i64().unwrap() + 1, stopped["decision"].as_i64().unwrap(), "{report}");
    assert_eq!((&report["difference"], &report["same_mixture"]), (&Value::Null, &Value::Null));
    let shown = succeed(here, ["replay", "here"]);
    let (walk, step) = (&stopped["walk"], &stopped["step"]);
    let words = format!("(decision {}, walk {walk},", stopped["decision"]);
    assert!(shown.contains(&words) && shown.contains(&format!("step {step}) were not stored")), "{shown}");
}

#[test]
fn what_cannot_be_set_is_refused() {
    let directory = finished(&Small { steps: 60, ..Small::default() }, &[]);
    let here = directory.path();
    for (setting, words) in [
        ("walk.tau=0.2", "walk.tau cannot be replayed: expected a key that acts on the selector alone"),
        ("collect.max_per_walk=0", "expected a whole number above 0"),
        ("collect.criterion.threshold=\"a\"", "--set collect.criterion.threshold=\"a\": "),
        ("calm.update=per_seed_structure", "run.walks_per_round = 1"),
    ] {
        let message = refuse(here, ["replay", "here", "--set", setting]);
        assert!(message.contains(words), "{message}");
    }
    let message = refuse(here, ["replay", "nowhere"]);
    assert!(message.contains("nowhere"), "{message}");
}

#[test]
fn files_are_found_where_they_are_and_must_be_the_same() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let small = Small { steps: 120, ..Small::default() };
    let path = small.write(here);
    let model = config("data/al_eam_1l/kokkos.npz");
    fs::copy(&model, here.join("model.npz")).unwrap();
    change(&path, &[(model.to_str().unwrap(), "model.npz")]);
    succeed(here, RUN);
    check_exact(here);
    fs::rename(here.join("model.npz"), here.join("moved.npz")).unwrap();
    let message = refuse(here, ["replay", "here"]);
    assert!(
        message.contains("potential.model: cannot read ") && message.contains("--model FILE"),
        "{message}"
    );
    succeed(here, ["replay", "here", "--model", "moved.npz"]);
    let artifact = config("data/al_eam_1l/gmm_artifacts.npz");
    let message = refuse(here, ["replay", "here", "--model", artifact.to_str().unwrap()]);
    assert!(message.contains("has another content (BLAKE3 "), "{message}");
}

#[test]
fn what_was_changed_behind_its_back_is_found() {
    let directory = finished(&Small::default(), &[]);
    let here = directory.path();
    let fails = |words: &[&str]| {
        let output = calmwalk(here, ["replay", "here"]);
        let message = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{message}");
        assert!(!message.contains("panicked"), "{message}");
        assert!(words.iter().all(|word| message.contains(word)), "{message}\nexpected {words:?}");
    };
    let database = here.join("here/campaign.sqlite");
    let whole = fs::read(&database).unwrap();
    let first = "(SELECT min(sequence) FROM decision WHERE kind = 'accepted')";
    let alpha = format!(
        "UPDATE decision SET detail = json_set(detail, '$.update.alpha', 0.123) WHERE sequence = {first}"
    );
    execute(here, &[&alpha]);
    fails(&["damaged database: decision ", "its content has the checksum "]);
    // With a matching checksum, only the replay can detect the change.
    let message = stderr(&calmwalk(here, ["replay", "here"]));
    let checksum = message.split("its content has the checksum ").nth(1).unwrap().split(',').next().unwrap();
    let checksum = u32::from_str_radix(checksum, 16).unwrap();
    execute(here, &[&format!("UPDATE decision SET checksum = {checksum} WHERE sequence = {first}")]);
    fails(&["is not reproduced", "detail.update.alpha was 0.123, and is now "]);
    for (statement, words) in [
        (format!("DELETE FROM decision WHERE sequence = {first}"), &["the database is damaged"][..]),
        (format!("DELETE FROM candidate_data WHERE decision = {first}"), &["its candidate is missing"]),
        (
            format!("UPDATE candidate_data SET block = substr(block, 1, 400) WHERE decision = {first}"),
            &["candidate block"],
        ),
        (
            format!("UPDATE candidate_data SET features = substr(features, 1, 400) WHERE decision = {first}"),
            &["the features of candidate ", "its content has the checksum "],
        ),
        (
            "UPDATE candidate_data SET selector_grades = original_grades WHERE decision =
                (SELECT max(decision) FROM candidate WHERE fate = 'accepted' AND origin = 'biased')"
                .to_owned(),
            &["of candidate ", "its content has the checksum "],
        ),
        ("UPDATE component SET bytes = zeroblob(length(bytes)) WHERE slot = (SELECT min(slot) FROM component)".to_owned(),
         &["component"]),
        (format!("UPDATE decision SET detail = '{{' WHERE sequence = {first}"), &["decision ", "its content has the checksum "]),
        (format!("UPDATE decision SET kind = 'tried' WHERE sequence = {first}"), &["decision ", "its content has the checksum "]),
    ] {
        fs::write(&database, &whole).unwrap();
        execute(here, &[&statement]);
        fails(words);
    }
}

#[test]
fn labels_play_no_part() {
    let directory = finished(&Small { steps: 120, ..Small::default() }, &[]);
    execute(directory.path(), &["DELETE FROM label"]);
    check_exact(directory.path());
}
