//! `calmwalk label`: labellers that `run` does not start. With `CALMWALK_POSTGRES` the same tests use a server.

use std::fs;
use std::process::Command;
use std::time::{Duration, Instant};

use store::{JobState, LabelStatus};

use crate::common::campaign::{Small, outcome_at};
use crate::common::hosts::uninterrupted_outcome;
use crate::common::label_campaign::LabelCampaign;
use crate::common::processes::{
    assert_no_leftovers, pause_walkers, processes_in, processes_running, signal, wait_until,
};
use crate::common::{Running, calmwalk, config, program, refuse};

/// `run` starts no labellers.
const NO_SLOTS: (&str, &str) = ("[label]", "[label]\nconcurrency = 0");

fn ended(running: &mut Running) -> Option<i32> {
    running.0.wait().expect("a child").code()
}

/// A finished campaign with one queued structure whose label takes a while. Returns the structure's name as well.
fn with_large_structure(changes: &[(&str, &str)]) -> (LabelCampaign, String) {
    let place = LabelCampaign::new(&Small { steps: 60, ..Small::default() }, changes);
    assert_eq!(ended(&mut place.run()), Some(0), "{}", place.said());
    let name = place.queue_large();
    (place, name)
}

#[test]
fn a_campaign_without_labellers_of_its_own_is_labelled_by_others() {
    let small = Small::default();
    let place = LabelCampaign::new(&small, &[NO_SLOTS]);
    // A labeller may start before the campaign exists.
    let mut label = place.label(&["--concurrency", "2", "--method", "potential", "--wait-timeout", "2m"]);
    wait_until("the labeller waits", || {
        place.said().contains("waiting for the campaign: there is no campaign in")
    });
    let mut run = place.run();
    // The campaign must not end before both slots have been seen.
    let held = pause_walkers(place.path(), small.walkers);
    wait_until("both label workers show in status", || {
        let status = place.status();
        let processes = status["processes"].as_array().cloned().unwrap_or_default();
        let slots =
            processes.iter().filter(|process| process["kind"] == "labeller" && process["state"] == "running");
        slots.count() == 2
    });
    held.resume();
    assert_eq!(ended(&mut run), Some(0), "{}", place.said());
    assert_eq!(ended(&mut label), Some(0), "{}", place.said());
    let said = place.said();
    assert!(said.contains("label.concurrency = 0: start labellers with calmwalk label --store "), "{said}");
    let labels = place.jobs("labelled") as usize;
    assert!(labels > 0 && said.matches(": labelled ").count() == labels, "{labels} in {said}");
    assert_eq!(outcome_at(place.argument(), place.path()), uninterrupted_outcome(&small));
    assert_eq!(place.status()["processes"], serde_json::json!([]));
    assert_no_leftovers(place.path());
}

#[test]
fn everything_in_one_process_waits_for_labels_of_others() {
    let small = Small { steps: 60, ..Small::default() };
    let place = LabelCampaign::new(&small, &[NO_SLOTS]);
    let mut run = place.start(&["run", "campaign.toml", "--directory", ".", "--in-process"]);
    wait_until("all walks have ended", || {
        let status = place.status();
        let walks = status["walks"].as_array().cloned().unwrap_or_default();
        let under_way = |walk: &&serde_json::Value| walk["state"] == "running" || walk["state"] == "waiting";
        place.jobs("queued") > 0 && !walks.iter().any(|walk| under_way(&walk))
    });
    assert!(run.0.try_wait().unwrap().is_none(), "{}", place.said());
    assert_eq!(ended(&mut place.label(&["--until-empty"])), Some(0), "{}", place.said());
    assert_eq!(ended(&mut run), Some(0), "{}", place.said());
    assert_eq!(outcome_at(place.argument(), place.path()), uninterrupted_outcome(&small));
}

#[test]
fn the_job_of_a_killed_labeller_is_labelled_by_the_next() {
    let (place, name) = with_large_structure(&[]);
    let mut label = place.label(&["--until-empty"]);
    // Pause its slot, so that the label is not made before the kill.
    let slot = place.pause_labeller();
    label.0.kill().unwrap();
    label.0.wait().unwrap();
    wait_until("its label worker has exited", || processes_in(place.path()).is_empty());
    drop(slot);
    assert_ne!(place.job(&name).job.state, JobState::Labelled);
    assert_eq!(ended(&mut place.label(&["--until-empty"])), Some(0), "{}", place.said());
    let job = place.job(&name);
    let outcomes: Vec<_> = job.attempts_made.iter().map(|attempt| attempt.outcome.as_deref()).collect();
    assert_eq!((job.job.state, job.job.failures), (JobState::Labelled, 0));
    assert_eq!(outcomes, [Some("lost"), Some("labelled")]);
}

#[test]
fn a_slot_that_is_killed_is_replaced_and_the_others_continue() {
    let (place, name) = with_large_structure(&[]);
    let mut label = place.label(&["--concurrency", "2", "--until-empty"]);
    place.wait_for_lease();
    let slots = processes_running(place.path(), "labeller");
    // Pause all slots, so that the label is not made before its slot is found.
    let held = place.pause(&slots);
    let holder = place.job(&name).job.holder.unwrap();
    let pid: u32 = holder.rsplit('-').nth(1).unwrap().parse().unwrap();
    assert!(slots.len() == 2 && slots.contains(&pid), "{slots:?} {holder}");
    signal(pid, "KILL");
    held.resume();
    assert_eq!(ended(&mut label), Some(0), "{}", place.said());
    assert!(place.said().contains("killed by signal 9 (SIGKILL); backing off"), "{}", place.said());
    assert_eq!(place.job(&name).job.state, JobState::Labelled);
    assert_eq!(place.status()["processes"], serde_json::json!([]));
}

#[test]
fn a_stop_finishes_the_current_label_or_gives_it_back() {
    let (place, name) = with_large_structure(&[]);
    let mut label = place.label(&["--grace-period", "0s"]);
    place.wait_for_lease();
    signal(label.0.id(), "TERM");
    assert_eq!(ended(&mut label), Some(130), "{}", place.said());
    assert_eq!(place.job(&name).job.state, JobState::Queued);
    assert_eq!(place.job(&name).attempts_made[0].outcome.as_deref(), Some("released"));
    assert!(place.said().contains("there is no time to finish it"), "{}", place.said());
    let mut label = place.label(&["--grace-period", "100s"]);
    place.wait_for_lease();
    signal(label.0.id(), "INT");
    assert_eq!(ended(&mut label), Some(130), "{}", place.said());
    assert_eq!(place.job(&name).job.state, JobState::Labelled);
    wait_until("all processes have exited", || processes_in(place.path()).is_empty());
    assert_eq!(place.status()["processes"], serde_json::json!([]));
}

#[test]
fn wrong_files_methods_and_stores_are_refused() {
    let label = config("data/Al_mm.eam.fs");
    let place = LabelCampaign::new(
        &Small { steps: 60, ..Small::default() },
        &[(&label.display().to_string(), "label.eam.fs"), NO_SLOTS],
    );
    let here = place.path();
    let content = fs::read_to_string(&label).unwrap();
    fs::write(here.join("label.eam.fs"), &content).unwrap();
    let mut run = place.run();
    wait_until("there is a structure", || place.jobs("queued") > 0);
    fs::write(here.join("other.eam.fs"), format!("another comment{content}")).unwrap();
    fs::rename(here.join("label.eam.fs"), here.join("moved.eam.fs")).unwrap();
    let command = |arguments: &[&str]| {
        let all = [&["label", "--until-empty", "--store", place.argument()], arguments].concat();
        all.into_iter().map(str::to_owned).collect::<Vec<_>>()
    };
    let message = refuse(here, command(&[]));
    let hash = blake3::hash(content.as_bytes()).to_string();
    for words in ["label.method.potential.file: ", &hash, "label.eam.fs cannot be read here", "--file"] {
        assert!(message.contains(words), "{message}");
    }
    for given in [&["--file", "other.eam.fs"][..], &["--file", "moved.eam.fs", "--file", "other.eam.fs"]] {
        let message = refuse(here, command(given));
        assert!(message.contains("--file other.eam.fs: its content (BLAKE3 "), "{message}");
    }
    let message = refuse(here, command(&["--file", "missing"]));
    assert!(message.contains("--file missing: cannot be read"), "{message}");
    fs::copy(here.join("other.eam.fs"), here.join("label.eam.fs")).unwrap();
    let message = refuse(here, command(&[]));
    assert!(message.contains("label.eam.fs here has another content (BLAKE3 "), "{message}");
    let message = refuse(here, command(&["--method", "vasp"]));
    assert!(
        message.contains("--method vasp, but the labels of this campaign are made by the method 'potential'")
    );

    let empty = tempfile::tempdir().unwrap();
    let nowhere = match place.argument() {
        "." => empty.path().display().to_string(),
        url => format!("{url}_other"),
    };
    let message = refuse(here, ["label", "--store", &nowhere]);
    assert!(message.contains("there is no campaign in"), "{message}");

    let mut labelling = place.label(&["--until-empty", "--file", "moved.eam.fs"]);
    assert_eq!(ended(&mut run), Some(0), "{}", place.said());
    assert_eq!(ended(&mut labelling), Some(0), "{}", place.said());
}

/// The program on a simulated other host, which has its own process ids and, on a server, its own boot id. `None` where this
/// is not permitted.
fn elsewhere(place: &LabelCampaign) -> Option<Command> {
    let boot = place.path().join("boot_id");
    fs::write(&boot, "11111111-2222-3333-4444-555555555555\n").unwrap();
    let flags = ["--user", "--map-root-user", "--pid", "--fork", "--kill-child", "--mount-proc"];
    // Another boot id only where hosts share the database: with SQLite, processes of another boot count as dead.
    let other_boot = match place.argument() {
        "." => "true".to_owned(),
        _ => format!("mount --bind {} /proc/sys/kernel/random/boot_id", boot.display()),
    };
    let permitted = Command::new("unshare").args(flags).args(["sh", "-c", &other_boot]).output();
    if !permitted.is_ok_and(|output| output.status.success()) {
        assert!(std::env::var_os("CI").is_none(), "unshare(1) must be permitted in CI");
        eprintln!("not tested: unshare(1) is not permitted here");
        return None;
    }
    let mut command = Command::new("unshare");
    let script = format!("{other_boot} && exec {} \"$@\"", program(place.path()).get_program().display());
    command.current_dir(place.path()).args(flags).args(["sh", "-c", &script, "sh"]);
    Some(command)
}

/// A labeller on another host is paused for longer than its lease, and resumes after another labeller has made the label.
#[test]
fn a_label_that_comes_too_late_is_a_check_and_changes_nothing() {
    let (place, name) = with_large_structure(&[("[label]", "[label]\nlease_timeout = \"2s\"")]);
    let Some(command) = elsewhere(&place) else { return };
    let arguments = ["label", "--until-empty", "--store", place.argument()];
    let mut late = place.spawn(command, &arguments);
    let slot = place.pause_labeller();
    let begun = Instant::now();
    let first = place.job(&name).job;
    assert_eq!(
        (first.state, first.attempts),
        (JobState::Leased, 1),
        "it was paused too late: {}",
        place.said()
    );
    assert_eq!(ended(&mut place.label(&["--until-empty"])), Some(0), "{}", place.said());
    assert!(begun.elapsed() > Duration::from_secs(1), "the lease had not expired");
    let exported = place.export();
    slot.resume();
    assert_eq!(ended(&mut late), Some(0), "{}", place.said());
    assert!(place.said().contains("has a label already; this result is kept as a check"), "{}", place.said());
    let job = place.job(&name);
    let outcomes: Vec<_> = job.attempts_made.iter().map(|attempt| attempt.outcome.as_deref()).collect();
    assert_eq!(outcomes, [Some("check"), Some("labelled")]);
    let statuses: Vec<_> = job.energies.iter().map(|(status, _)| *status).collect();
    assert_eq!((job.job.state, statuses), (JobState::Labelled, vec![LabelStatus::Label, LabelStatus::Check]));
    assert_eq!(place.export(), exported);
}

/// A process that this host cannot see does not count as dead: neither `run` nor another labeller takes its job.
#[test]
fn a_labeller_on_another_host_keeps_its_job_when_a_run_starts() {
    let (place, name) = with_large_structure(&[("[label]", "[label]\nlease_timeout = \"1m\"")]);
    let Some(command) = elsewhere(&place) else { return };
    let arguments = ["label", "--until-empty", "--store", place.argument()];
    let mut label = place.spawn(command, &arguments);
    let slot = place.pause_labeller();
    let mut run = place.run();
    wait_until("the run has started", || {
        let output = calmwalk(place.path(), ["status", place.argument()]);
        String::from_utf8_lossy(&output.stdout).contains("\nstate       running")
    });
    // Longer than the interval of the check for dead processes.
    std::thread::sleep(Duration::from_secs(6));
    assert_eq!(place.job(&name).job.attempts, 1, "{}", place.said());
    assert!(run.0.try_wait().unwrap().is_none(), "{}", place.said());
    slot.resume();
    assert_eq!(ended(&mut label), Some(0), "{}", place.said());
    assert_eq!(ended(&mut run), Some(0), "{}", place.said());
    let job = place.job(&name);
    assert_eq!((job.job.state, job.job.attempts, job.energies.len()), (JobState::Labelled, 1, 1));
}
