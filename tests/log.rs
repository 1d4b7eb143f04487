//! The log of a campaign.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use serde_json::Value;

use crate::common::campaign::Small;
use crate::common::{calmwalk, refuse, stderr, succeed};

fn read(path: &Path) -> Vec<Value> {
    let text = fs::read_to_string(path).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|_| panic!("{line}"))).collect()
}

fn said<'a>(log: &'a [Value], message: &str) -> Vec<&'a Value> {
    log.iter().filter(|event| event["message"] == message).collect()
}

#[test]
fn a_log_has_what_all_processes_of_a_campaign_do() {
    let directory = tempfile::tempdir().unwrap();
    Small::default().write(directory.path());
    let dashboard = ["--dashboard", "127.0.0.1:0"];
    let log = ["--log", "log.jsonl", "--log-level", "debug", "--log-format", "json"];
    let output = calmwalk(directory.path(), ["run", "campaign.toml"].iter().chain(&dashboard).chain(&log));
    assert!(output.status.success(), "{}", stderr(&output));
    let text = fs::read_to_string(directory.path().join("log.jsonl")).unwrap();
    let log = read(&directory.path().join("log.jsonl"));

    let status = succeed(directory.path(), ["status", "campaign", "--json"]);
    let status: Value = serde_json::from_str(&status).unwrap();
    let decided = said(&log, "decided");
    let kinds = |kind: &str| decided.iter().filter(|event| event["fields"]["kind"] == kind).count();
    assert!(kinds("accepted") > 0);
    assert_eq!(kinds("accepted") as u64, status["candidates"]["accepted"]);
    assert_eq!(kinds("control") as u64, status["candidates"]["control"]);
    assert!(decided.iter().all(|event| event["process"] == "orchestrator"));
    let labels = log.iter().filter(|event| event["message"].as_str().unwrap().starts_with("labelled "));
    let labels: Vec<_> = labels.collect();
    assert_eq!(labels.len() as u64, status["labels"]["labelled"]);
    assert!(labels.iter().all(|event| event["process"].as_str().unwrap().starts_with("labeller ")));
    assert_eq!(said(&log, "leased").len(), labels.len());

    let assignments = said(&log, "finished an assignment");
    let by: BTreeSet<_> = assignments.iter().map(|event| event["process"].as_str().unwrap()).collect();
    assert!(!by.is_empty() && by.iter().all(|name| ["walker 0", "walker 1"].contains(name)), "{by:?}");
    assert!(assignments.iter().all(|event| event["fields"]["seconds"].as_f64().unwrap() > 0.0));
    assert!(!said(&log, "committed").is_empty());
    let operations = said(&log, "operation");
    let kinds: Vec<_> = operations.iter().map(|event| event["fields"]["kind"].as_str().unwrap()).collect();
    assert!(
        kinds.contains(&"created") && kinds.contains(&"started") && kinds.contains(&"ended"),
        "{kinds:?}"
    );
    assert!(log.iter().all(|event| event["time"].as_str().unwrap().ends_with('Z')));

    let said = stderr(&output);
    let (_, token) = said.split_once("#token=").expect("the dashboard's address");
    let token = token.lines().next().unwrap();
    assert!(token.len() == 32 && !text.contains(token));
    assert!(text.contains("dashboard at http://127.0.0.1:"));
}

#[test]
fn a_log_grows_from_run_to_run_and_has_no_more_than_it_is_to_have() {
    let directory = tempfile::tempdir().unwrap();
    Small { max_per_walk: 1, steps: 60, ..Small::default() }.write(directory.path());
    let run = ["run", "campaign.toml", "--in-process", "--log", "campaign.log"];
    succeed(directory.path(), run);
    let first = fs::read_to_string(directory.path().join("campaign.log")).unwrap();
    assert!(first.contains(" INFO  orchestrator ["), "{first}");
    assert!(!first.contains(" DEBUG "), "{first}");
    succeed(directory.path(), run);
    let both = fs::read_to_string(directory.path().join("campaign.log")).unwrap();
    assert!(both.starts_with(&first) && both.len() > first.len());
}

#[test]
fn a_failure_is_in_the_log_and_a_password_is_not() {
    let directory = tempfile::tempdir().unwrap();
    let store = "postgres://calm:swordfish@127.0.0.1:1/nothing";
    let output = calmwalk(directory.path(), ["label", "--store", store, "--log", "label.log"]);
    assert!(!output.status.success());
    let log = fs::read_to_string(directory.path().join("label.log")).unwrap();
    assert!(log.contains(" ERROR label ["), "{log}");
    assert!(!log.contains("swordfish") && !stderr(&output).contains("swordfish"), "{log}");
}

#[test]
fn wrong_arguments_of_the_log_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    Small::default().write(directory.path());
    let run = ["run", "campaign.toml", "--in-process"];
    let nowhere = refuse(directory.path(), run.iter().chain(&["--log", "no/such/directory/log"]));
    assert!(
        nowhere.contains("--log: cannot write to") && nowhere.contains("no/such/directory/log"),
        "{nowhere}"
    );
    let alone = refuse(directory.path(), run.iter().chain(&["--log-level", "debug"]));
    assert!(alone.contains("--log <FILE>"), "{alone}");
    let unknown = refuse(directory.path(), run.iter().chain(&["--log", "log", "--log-level", "loud"]));
    assert!(unknown.contains("loud") && unknown.contains("debug"), "{unknown}");
}
