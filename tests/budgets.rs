//! Budgets end a campaign cleanly, and a larger budget continues it; effects of a long label queue.

use std::fs;
use std::io::Read;
use std::path::Path;
use std::process::Stdio;

use serde_json::Value;
use tempfile::TempDir;

use crate::common::campaign::{Counters, Small, outcome};
use crate::common::config_tester::ConfigTester;
use crate::common::hosts::uninterrupted_outcome;
use crate::common::processes::{PausedProcesses, processes_running, wait_until};
use crate::common::{Running, program, succeed};

const RUN: [&str; 4] = ["run", "campaign.toml", "--directory", "here"];

fn write(small: &Small, more: &str) -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    let path = small.write(directory.path());
    let text = fs::read_to_string(&path).unwrap();
    fs::write(path, text + more).unwrap();
    directory
}

fn change(directory: &Path, from: &str, to: &str) {
    let path = directory.join("campaign.toml");
    let text = fs::read_to_string(&path).unwrap();
    assert!(text.contains(from), "no {from}");
    fs::write(path, text.replacen(from, to, 1)).unwrap();
}

fn status(directory: &Path) -> Value {
    serde_json::from_str(&succeed(directory, ["status", "here", "--json"])).unwrap()
}

/// States of the biased walks.
fn walks(status: &Value) -> Vec<(String, String)> {
    let biased = status["walks"].as_array().unwrap().iter().filter(|walk| walk["origin"] == "biased");
    let text = |value: &Value| value.as_str().unwrap().to_owned();
    biased.map(|walk| (text(&walk["state"]), text(&walk["reason"]))).collect()
}

fn decisions(directory: &Path) -> Vec<String> {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let text = runtime.block_on(async {
        let store = store::Store::open_read_only(&directory.join("here")).await.unwrap();
        store.decision_log_text().await.unwrap()
    });
    text.lines().map(str::to_owned).collect()
}

/// Number of labels that took a millisecond or more; shorter ones cost nothing.
fn costly_labels(directory: &Path) -> usize {
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let store = store::Store::open_read_only(&directory.join("here")).await.unwrap();
        let mut costly = 0;
        for job in store.queue_list(Some(store::JobState::Labelled), u32::MAX, 0).await.unwrap() {
            let attempts = store.queue_show(&job.candidate).await.unwrap().attempts_made;
            costly += attempts.iter().filter(|attempt| attempt.ended > Some(attempt.started)).count();
        }
        costly
    })
}

#[test]
fn the_budget_of_labels_limits_how_many_structures_are_collected() {
    // A structure takes two labels: its own and its control frame's.
    let small = Small { walks_per_round: 1, ..Small::default() };
    let directory = write(&small, "[budget]\nlabels = 5\n");
    let here = directory.path();
    let summary = succeed(here, RUN);
    assert!(
        summary.contains("budget           labels 4 of 5; walks were ended by budget.labels"),
        "{summary}"
    );
    assert!(summary.contains("\nend              budget.labels is used up\n"), "{summary}");
    let ended = status(here);
    assert_eq!(
        (&ended["end_reason"]["kind"], &ended["end_reason"]["key"]),
        (&"budget".into(), &"budget.labels".into())
    );
    assert_eq!((&ended["candidates"]["accepted"], &ended["labels"]["labelled"]), (&2.into(), &4.into()));
    assert_eq!((&ended["finished"], &ended["budget"]["used_up"]), (&true.into(), &"budget.labels".into()));
    let by_budget = ("budget".to_owned(), "budget.labels".to_owned());
    assert!(walks(&ended).contains(&by_budget), "{ended}");
    let shown = succeed(here, ["status", "here"]);
    assert!(shown.contains("state       finished: budget.labels is used up"), "{shown}");
    // The decisions do not depend on the number of walkers.
    let other = write(&Small { walkers: 1, ..small.clone() }, "[budget]\nlabels = 5\n");
    succeed(other.path(), RUN);
    assert_eq!(decisions(here), decisions(other.path()));

    change(here, "labels = 5", "labels = 6");
    succeed(here, RUN);
    let more = status(here);
    assert_eq!((&more["candidates"]["accepted"], &more["labels"]["labelled"]), (&3.into(), &6.into()));
    change(here, "labels = 6", "");
    succeed(here, RUN);
    assert!(!walks(&status(here)).contains(&by_budget));
    outcome(&here.join("here"));
    succeed(here, ["replay", "here"]);
}

#[test]
fn walks_end_when_they_find_nothing_new_and_go_on_with_a_larger_limit() {
    let directory = write(&Small::default(), "[stop]\nmax_steps_without_structure = 100\n");
    let here = directory.path();
    change(
        here,
        "criterion = { rule = \"atom_count\", threshold = 1.0",
        "criterion = { rule = \"atom_count\", threshold = 900.0",
    );
    let summary = succeed(here, RUN);
    let reason = "walks found nothing new in 100 steps (stop.max_steps_without_structure)";
    assert!(summary.contains(&format!("\nend              {reason}\n")), "{summary}");
    // Two rounds of two walks.
    let ended = status(here);
    assert_eq!(walks(&ended), [(); 2].map(|()| ("nothing_new".to_owned(), String::new())));
    assert_eq!((&ended["end_reason"]["steps"], &ended["walks"][1]["step"]), (&100.into(), &80.into()));
    let so_far = decisions(here);
    succeed(here, RUN);
    assert_eq!(decisions(here), so_far, "the same run comes to the same end");
    change(here, "max_steps_without_structure = 100", "max_steps_without_structure = 10000");
    assert!(succeed(here, RUN).contains("\nend              all walks have ended\n"));
    assert_eq!(walks(&status(here)), [(); 2].map(|()| ("completed".to_owned(), String::new())));
    succeed(here, ["replay", "here"]);
}

/// Runs a campaign until its time is used up, and pauses its walkers before they can end their walks. Returns its summary.
fn run_until_the_time_is_used_up(here: &Path) -> String {
    let said = || fs::read_to_string(here.join("said")).unwrap_or_default();
    let used_up = || said().contains("budget.wall_time is used up");
    let stderr = fs::File::create(here.join("said")).unwrap();
    let mut run = program(here).args(RUN).stdout(Stdio::piped()).stderr(stderr).spawn().unwrap();
    let mut summary = run.stdout.take().unwrap();
    let mut run = Running(run);
    wait_until("structures are found", || used_up() || Counters::read("here", here).sent > 0);
    let held = PausedProcesses::new(processes_running(here, "walker"));
    wait_until("the time is used up", used_up);
    held.resume();
    let mut text = String::new();
    summary.read_to_string(&mut text).unwrap();
    assert_eq!(run.0.wait().unwrap().code(), Some(0), "{}", said());
    text
}

#[test]
fn a_time_limit_stops_walks_at_their_current_step() {
    let small = Small::default();
    let expected = uninterrupted_outcome(&small);
    let directory = write(&small, "[budget]\nwall_time = \"2s\"\n");
    let here = directory.path();
    let summary = run_until_the_time_is_used_up(here);
    assert!(summary.contains("walks were ended by budget.wall_time"), "{summary}");
    let stopped = status(here);
    assert_eq!(
        (&stopped["finished"], &stopped["budget"]["used_up"]),
        (&true.into(), &"budget.wall_time".into())
    );
    // The campaign checks the clock at intervals: a walk may have completed before.
    let walks = walks(&stopped);
    assert!(walks.iter().all(|(state, _)| !["waiting", "running"].contains(&state.as_str())), "{walks:?}");
    assert!(walks.contains(&("budget".into(), "budget.wall_time".into())), "{walks:?}");
    assert!(stopped["budget"]["used"]["wall_hours"].as_f64() >= Some(2.0 / 3600.0), "{stopped}");
    let so_far = decisions(here);
    let all: Vec<_> = expected.decisions.lines().map(str::to_owned).collect();
    assert!(
        so_far.len() < all.len() && so_far == all[..so_far.len()],
        "the first decisions of the undisturbed campaign"
    );
    // No walk starts while the budget is used up.
    succeed(here, RUN);
    assert_eq!(decisions(here), so_far);
    change(here, "\"2s\"", "\"10h\"");
    succeed(here, RUN);
    assert_eq!(outcome(&here.join("here")), expected);
}

#[test]
fn labels_beyond_the_core_hours_are_not_started() {
    for in_process in [false, true] {
        let directory = write(&Small { mode: "live", ..Small::default() }, "[budget]\ncore_hours = 1e-9\n");
        let here = directory.path();
        let run: Vec<_> = RUN.into_iter().chain(in_process.then_some("--in-process")).collect();
        let summary = succeed(here, &run);
        assert!(summary.contains("walks were ended by budget.core_hours"), "{summary}");
        let stopped = status(here);
        assert_eq!((&stopped["finished"], &stopped["labels"]["leased"]), (&true.into(), &0.into()));
        assert_eq!(costly_labels(here), 1, "{stopped}");
        change(here, "core_hours = 1e-9", "core_hours = 10");
        succeed(here, &run);
        outcome(&here.join("here"));
        let done = status(here);
        assert_eq!((&done["budget"]["used_up"], &done["labels"]["queued"]), (&Value::Null, &0.into()));
    }
}

#[test]
fn a_long_queue_raises_the_threshold_and_the_log_can_be_replayed() {
    let directory = write(&Small { mode: "live", steps: 2000, ..Small::default() }, "");
    let here = directory.path();
    change(here, "[run]", "queue_limit = 4\non_queue_full = \"raise\"\norder = \"value\"\n[run]");
    let run = program(here).args(RUN).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let mut run = Running(run);
    // The queue only grows while the labellers are paused.
    wait_until("a labeller is running", || !processes_running(here, "labeller").is_empty());
    let labellers = processes_running(here, "labeller");
    let held = PausedProcesses::outside_transactions(labellers, here.join("here").to_str().unwrap());
    let raised = || decisions(here).into_iter().filter(|line| line.contains("\"raised_by\"")).count();
    wait_until("the threshold is raised", || here.join("here/campaign.sqlite").exists() && raised() > 0);
    // The run computes what the labels of the queue are worth.
    let list = ["queue", "here", "list", "--state", "queued", "--json"];
    let jobs = || serde_json::from_str::<Vec<Value>>(&succeed(here, list)).unwrap();
    wait_until("structures have values", || jobs().iter().any(|job| job["value"].is_number()));
    let jobs = jobs();
    let valued = jobs.iter().find(|job| job["value"].is_number()).unwrap();
    assert!(valued["value_factors"]["diversity"].as_f64().is_some_and(|part| part <= 1.0), "{valued}");
    held.resume();
    assert!(run.0.wait().unwrap().success());
    outcome(&here.join("here"));
    let report: Value = serde_json::from_str(&succeed(here, ["replay", "here", "--json"])).unwrap();
    assert_eq!((&report["difference"], &report["same_mixture"]), (&Value::Null, &true.into()), "{report}");
}

#[test]
fn wrong_budgets_and_queues_are_refused() {
    let tester = ConfigTester::new();
    tester.refused_with(
        "# labels = 1000",
        "labels = 1",
        &["budget.labels is 1; expected at least 2: a structure and its control"],
    );
    tester.refused_with("# labels = 1000", "labels = 0", &["expected a whole number above 0"]);
    tester.refused_with("# wall_time = \"24h\"", "wall_time = 24.0", &["a time with its unit"]);
    tester.refused_with(
        "# wall_time = \"24h\"",
        "wall_time = \"0s\"",
        &["budget.wall_time", "1ms to 10years"],
    );
    tester.refused_with("# core_hours = 100.0", "core_hour = 100.0", &["did you mean `core_hours`?"]);
    tester.refused_with(
        "# on_queue_full = \"wait\"",
        "on_queue_full = \"raise\"",
        &[
            "label.on_queue_full is \"raise\"; expected \"wait\", or mode = \"live\"",
            "the speed of the labellers",
        ],
    );
    tester.refused_with(
        "# min_completion_probability = 0.9",
        "min_completion_probability = 0.9",
        &["collect.min_completion_probability is 0.9; expected mode = \"live\"", "not reproducible"],
    );
    tester.refused_with(
        "# min_completion_probability = 0.9",
        "min_completion_probability = 1.5",
        &["expected a number above 0 and not above 1"],
    );
}
