//! Notifications: each event is sent once, and a failing command does not disturb the campaign.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Stdio;

use serde_json::Value;

use crate::common;
use crate::common::campaign::Small;
use crate::common::processes::{signal, wait_until};
use crate::common::{Running, program, succeed};

const RUN: [&str; 2] = ["run", "campaign.toml"];

/// Writes `campaign.toml`, and a notification script that appends a line to `events`, saves its input and ends with `last`.
fn write(here: &Path, small: &Small, notify: &str, change: (&str, &str), last: &str) {
    let script = format!(
        "#!/bin/sh\ncd '{}'\ncat > \"$CALMWALK_EVENT.json\"\necho \"$CALMWALK_EVENT $1 $CALMWALK_MESSAGE\" >> events\n{last}\n",
        here.display()
    );
    fs::write(here.join("tell.sh"), script).unwrap();
    fs::set_permissions(here.join("tell.sh"), fs::Permissions::from_mode(0o755)).unwrap();
    let path = small.write(here);
    let text = small.text().replace(change.0, change.1);
    fs::write(path, format!("{text}\n[notify]\ncommand = [\"./tell.sh\", \"argument\"]\n{notify}\n"))
        .unwrap();
}

fn events(here: &Path) -> Vec<String> {
    let text = fs::read_to_string(here.join("events")).unwrap_or_default();
    text.lines().map(|line| line.split_once(' ').unwrap().0.to_owned()).collect()
}

/// Entries of these kinds in the operations log.
fn operations(here: &Path, kinds: &[&str]) -> Vec<(String, Value)> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
    let lines = runtime.block_on(async {
        let store = store::Store::open_read_only(here.join("campaign")).await.unwrap();
        let lines = store.operations(0, 10_000).await.unwrap();
        store.close().await;
        lines
    });
    let of_kind = lines.into_iter().filter(|line| kinds.contains(&line.kind.as_str()));
    of_kind.map(|line| (line.kind, line.detail)).collect()
}

#[test]
fn the_end_is_notified_once_with_the_state_of_the_campaign() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write(here, &Small::default(), "", ("[label]", "[budget]\nlabels = 4\n[label]"), "exit 0");
    succeed(here, RUN);
    assert_eq!(events(here).iter().filter(|event| *event == "end").count(), 1, "{:?}", events(here));
    assert!(events(here).contains(&"budget".into()));
    let told: Value = serde_json::from_slice(&fs::read(here.join("end.json")).unwrap()).unwrap();
    let status: Value = serde_json::from_str(&succeed(here, ["status", "campaign", "--json"])).unwrap();
    for key in ["version", "campaign", "candidates", "labels", "finished"] {
        assert_eq!(told["status"][key], status[key], "{key}");
    }
    assert_eq!((&told["event"], &told["location"]), (&"end".into(), &"campaign".into()));
    let line = fs::read_to_string(here.join("events")).unwrap();
    assert!(line.contains("end argument the campaign is finished: "), "{line}");
    let log = operations(here, &["notified", "not_notified"]);
    assert!(log.len() == 2 && log.iter().all(|(kind, _)| kind == "notified"), "{log:?}");
    // Running the same command again sends no notification.
    succeed(here, RUN);
    assert_eq!(events(here).len(), 2);
}

#[test]
fn a_command_that_fails_or_hangs_is_recorded_in_the_log() {
    for (last, limit, words) in
        [("echo no network >&2; exit 3", 60, "no network"), ("exec sleep 1000", 3, "killed after 3 s")]
    {
        let directory = tempfile::tempdir().unwrap();
        let here = directory.path();
        let notify = format!("on = [\"end\"]\ntime_limit = \"{limit}s\"");
        write(here, &Small::default(), &notify, ("", ""), last);
        succeed(here, RUN);
        assert_eq!(events(here), ["end"]);
        let log = operations(here, &["notified", "not_notified"]);
        assert_eq!((log.len(), log[0].0.as_str()), (1, "not_notified"), "{log:?}");
        assert!(log[0].1["how"].as_str().unwrap().contains(words), "{log:?}");
    }
}

/// Sum of the steps of all walks up to their last checkpoints.
fn steps(here: &Path) -> u64 {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let store = store::Store::open_read_only(here.join("campaign")).await.unwrap();
        let walks = store.load_walks().await.unwrap();
        store.close().await;
        walks.iter().map(|walk| walk.progress.step).sum()
    })
}

#[test]
fn a_stall_is_notified_once_across_restarts() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let small = Small { steps: 1_000_000, ..Small::default() };
    let nothing_is_new = ("threshold = 1.0", "threshold = 1e6");
    write(here, &small, "stall_timeout = \"300ms\"", nothing_is_new, "exit 0");
    let start =
        || Running(program(here).args(RUN).stderr(Stdio::null()).stdout(Stdio::null()).spawn().unwrap());
    let run = start();
    wait_until("the stall is notified", || !operations_if_any(here).is_empty());
    drop(run);
    wait_until("all processes have exited", || common::processes::processes_in(here).is_empty());
    let before = steps(here);
    let mut run = start();
    // A run checks for events when it starts, and a last time when it is stopped. Between these two checks of the second run,
    // more time passes than the timeout of a stall.
    wait_until("the walks have advanced", || steps(here) > before);
    std::thread::sleep(std::time::Duration::from_millis(600));
    signal(run.0.id(), "TERM");
    assert_eq!(run.0.wait().unwrap().code(), Some(130));
    assert_eq!(events(here), ["stall"]);
}

/// Number of decisions so far that raised the forgetting alarm.
fn alarms(here: &Path) -> usize {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        // The database may not exist yet.
        let Ok(store) = store::Store::open_read_only(here.join("campaign")).await else { return 0 };
        let decisions = store.decisions(1..=i64::MAX).await.unwrap_or_default();
        store.close().await;
        decisions.iter().filter(|decision| decision.detail["forgetting_alarm"] == true).count()
    })
}

#[test]
fn forgetting_is_reported_once_per_run_and_notified_once() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let small = Small { steps: 900, ..Small::default() };
    let low = ("training_frames", "alpha_values = [1.0]\nforgetting_alarm = 0.02\ntraining_frames");
    write(here, &small, "on = [\"forgetting\"]\nstall_timeout = \"600ms\"", low, "exit 0");
    let said = here.join("said");
    let start = || {
        let said = fs::File::create(&said).unwrap();
        Running(program(here).args(RUN).stderr(said).stdout(Stdio::null()).spawn().unwrap())
    };
    let reports = || fs::read_to_string(&said).unwrap().matches("forgets its training data").count();
    let mut run = start();
    wait_until("there are several alarms", || alarms(here) >= 3);
    wait_until("the command has been called", || !events(here).is_empty());
    signal(run.0.id(), "TERM");
    run.0.wait().unwrap();
    let text = fs::read_to_string(&said).unwrap();
    assert_eq!(reports(), 1, "{text}");
    assert!(text.contains("ALARM: ") && text.contains("covariance_update = \"additive\""), "{text}");
    let before = alarms(here);
    assert_eq!(start().0.wait().unwrap().code(), Some(0));
    // How many decisions the second run makes depends on when the first was stopped: maybe none.
    let text = fs::read_to_string(&said).unwrap();
    assert_eq!(reports(), usize::from(alarms(here) > before), "{text}");
    let told = fs::read_to_string(here.join("events")).unwrap();
    assert_eq!(told.matches("forgetting argument the mixture forgets").count(), 1, "{told}");
}

fn operations_if_any(here: &Path) -> Vec<(String, Value)> {
    if here.join("events").exists() { operations(here, &["notified"]) } else { Vec::new() }
}
