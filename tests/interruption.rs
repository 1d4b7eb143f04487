//! A campaign survives the loss of its processes, and ends as if it had not been interrupted.
//!
//! `CALMWALK_KILLS=200 cargo test --test integration interruption::kills` runs a long version, 1000 a longer one;
//! `interruption::kills_of_a_campaign` runs only campaigns whose labels are made by a program.

use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

use crate::common;
use crate::common::campaign::{Counters, Outcome, Small, outcome};
use crate::common::hosts::{run_in_one_process, uninterrupted, uninterrupted_outcome};
use crate::common::label_campaign::WRITE_FIXED_LABEL;
use crate::common::processes::{
    assert_no_leftovers, calculation_processes, pause_walkers, processes_in, processes_running, signal,
    wait_until,
};
use crate::common::{Running, kills, program, random};

fn start(directory: &Path, options: &[&str]) -> Running {
    let mut command = program(directory);
    let command = command.args(["run", "campaign.toml", "--directory", "."]).args(options);
    Running(command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("the program starts"))
}

/// A function that writes a campaign.
type Write = fn(&Small, &Path);

fn plain(small: &Small, directory: &Path) {
    small.write(directory);
}

/// Writes a campaign whose labels are made by a program, in directories below `scratch`.
fn with_program(small: &Small, directory: &Path) {
    let scratch = directory.canonicalize().unwrap().join("scratch").display().to_string();
    std::fs::create_dir_all(&scratch).unwrap();
    std::fs::write(directory.join("label.sh"), format!("sleep 0.05\n{WRITE_FIXED_LABEL}")).unwrap();
    let command = r#"{ command = { command = ["sh", "label.sh"], files = ["label.sh"], version = "1" } }"#;
    let keys = format!("[label]\nmax_attempts = 20\nscratch = {scratch:?}\nmethod = {command} # ");
    std::fs::write(small.write(directory), small.text().replace("[label]\nmethod", &keys)).unwrap();
}

/// Maximum number of kills of labelling programs per campaign: each kill counts as a failure of its job, whose retries are
/// limited.
const PROGRAMS: u64 = 2;

/// Kills one process of the campaign, or all at once; the orchestrator if there is no process of the chosen kind. Returns
/// whether it was a labelling program.
fn kill(directory: &Path, running: &Running, choice: u64, programs_too: bool) -> bool {
    const ALL: u64 = 3;
    let kind = choice % 7;
    let mut victims = match kind {
        0 => vec![running.0.id()],
        1 => processes_running(directory, "walker"),
        2 => processes_running(directory, "labeller"),
        ALL => processes_in(directory).iter().map(|process| process.pid).collect(),
        4 => processes_running(directory, "calculation-runner"),
        6 => processes_running(directory, "refitter"),
        _ if programs_too => {
            let scratch = directory.canonicalize().unwrap().join("scratch");
            calculation_processes(&scratch)
                .into_iter()
                .filter(|(_, line)| line.starts_with("sh "))
                .map(|(pid, _)| pid)
                .collect()
        }
        _ => Vec::new(),
    };
    let is_program = kind == 5 && !victims.is_empty();
    if victims.is_empty() {
        victims.push(running.0.id());
    } else if kind != ALL {
        victims = vec![victims[(choice / 7) as usize % victims.len()]];
    }
    victims.into_iter().for_each(|pid| signal(pid, "KILL"));
    is_program
}

/// Runs campaigns with some kills in each, at any time from the start on, with one or two walkers.
fn disturbed(
    small: &Small,
    write: Write,
    (expected, takes): (Outcome, Duration),
    options: &[&str],
    kills: u64,
) -> Outcome {
    assert!(expected.decisions.matches("\"kind\":\"accepted\"").count() >= 4, "{}", expected.decisions);
    assert!(expected.decisions.contains("\"kind\":\"control\""));
    let (mut done, mut campaigns) = (0, 0);
    while done < kills {
        let directory = tempfile::tempdir().unwrap();
        campaigns += 1;
        let (mut finished, mut programs) = (false, 0);
        while !finished {
            write(&Small { walkers: 1 + (random(done) % 2) as usize, ..small.clone() }, directory.path());
            let mut running = start(directory.path(), options);
            let ended = loop {
                // Use other times in each campaign: otherwise a campaign that ends before its first kill would repeat
                // endlessly.
                let instant =
                    takes.mul_f64((random(1000 + done + 10_000 * campaigns) % 1000) as f64 / 1500.0);
                std::thread::sleep(instant);
                let ended = running.0.try_wait().unwrap();
                if ended.is_some() || done == kills {
                    break ended.unwrap_or_else(|| running.0.wait().unwrap());
                }
                let was_program = kill(directory.path(), &running, random(5000 + done), programs < PROGRAMS);
                programs += u64::from(was_program);
                done += 1;
                // The exit of a killed process is not visible immediately.
                std::thread::sleep(Duration::from_millis(5));
            };
            assert!(matches!(ended.code(), Some(0) | None), "{ended} after {done} kills");
            finished = ended.code() == Some(0);
        }
        assert_eq!(outcome(directory.path()), expected, "after {done} kills in {campaigns} campaigns");
        assert_no_leftovers(directory.path());
    }
    expected
}

#[test]
fn kills_at_random_times_change_nothing() {
    let small = Small::default();
    disturbed(&small, plain, uninterrupted(&small), &[], kills());
}

#[test]
fn kills_of_a_run_in_one_process_change_nothing() {
    let small = Small::default();
    disturbed(&small, plain, uninterrupted(&small), &["--in-process"], kills().div_ceil(4));
}

#[test]
fn kills_of_a_campaign_whose_labels_a_program_makes_change_nothing() {
    let small = Small { walkers: 1, ..Small::default() };
    let alone = run_in_one_process(|directory| with_program(&small, directory));
    disturbed(&small, with_program, alone, &[], kills().div_ceil(4));
}

#[test]
fn kills_of_a_campaign_that_trains_its_potential_change_nothing() {
    let small = Small::with_two_versions();
    let expected = disturbed(&small, plain, uninterrupted(&small), &[], kills().div_ceil(4));
    let found: Vec<_> =
        expected.versions.iter().map(|version| (version.number, version.state.name())).collect();
    assert_eq!(found, [(1, "registered"), (2, "registered")], "{:?}", expected.versions);
    assert!(expected.decisions.contains("\"kind\":\"version\""), "walks begin with the first");
    assert!(expected.decisions.contains("superseded"), "{}", expected.decisions);
}

#[test]
fn ctrl_c_and_sigterm_stop_cleanly_and_lose_nothing() {
    let small = Small::default();
    let expected = uninterrupted_outcome(&small);
    for name in ["INT", "TERM"] {
        let directory = tempfile::tempdir().unwrap();
        small.write(directory.path());
        let mut running = start(directory.path(), &[]);
        wait_until("structures are found", || Counters::read(".", directory.path()).sent > 0);
        // The campaign must not end before the signal.
        let held = pause_walkers(directory.path(), 2);
        signal(running.0.id(), name);
        held.resume();
        assert_eq!(running.0.wait().unwrap().code(), Some(130), "{name}");
        assert_eq!(start(directory.path(), &[]).0.wait().unwrap().code(), Some(0));
        assert_eq!(outcome(directory.path()), expected, "{name}");
        assert_no_leftovers(directory.path());
    }
}

#[test]
fn live_mode_loses_and_duplicates_nothing() {
    // Live mode takes about as long as reproducible mode.
    let (_, takes) = uninterrupted(&Small::default());
    let small = Small { mode: "live", ..Small::default() };
    let directory = tempfile::tempdir().unwrap();
    small.write(directory.path());
    for kill in 0..5 {
        let mut running = start(directory.path(), &[]);
        std::thread::sleep(takes.mul_f64((random(kill) % 1000) as f64 / 2000.0));
        running.0.kill().unwrap();
        running.0.wait().unwrap();
    }
    assert_eq!(start(directory.path(), &[]).0.wait().unwrap().code(), Some(0));
    outcome(directory.path());
    assert_no_leftovers(directory.path());
}

/// All walks have ended, but another labeller still makes a label: a stop now must not report a finished campaign.
#[test]
fn a_stop_while_labels_are_still_made_does_not_end_the_campaign() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let text = Small::default().text().replace("[label]", "[label]\nmax_force = 1e-6\nmax_attempts = 1");
    std::fs::write(Small::default().write(here), text).unwrap();
    assert_eq!(start(here, &[]).0.wait().unwrap().code(), Some(0));
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let store = store::Store::open(here).await.unwrap();
        let now = store::unix_milliseconds();
        let failed = store.queue_list(Some(store::JobState::Failed), 1, 0).await.unwrap();
        store.retry_job(&failed[0].candidate, now).await.unwrap();
        // This process cannot see whether a labeller in another container is alive.
        let here =
            store::ProcessRecord::new(store::ProcessRecord::LABELLER, Some(0), std::process::id(), now);
        let (place, ticks) = here.start_time.rsplit_once('/').unwrap();
        let start_time = format!("{place}0/{ticks}");
        let elsewhere = store::ProcessRecord { id: "elsewhere".into(), start_time, ..here };
        store.upsert_process(&elsewhere).await.unwrap();
        let protocol = store.protocols().await.unwrap()[0].hash;
        store.lease(protocol, "elsewhere", now, 600).await.unwrap().expect("the requeued job");
        store.close().await;
    });
    let mut running = start(here, &[]);
    let begun = Instant::now();
    while !common::succeed(here, ["status", ".", "--json"]).contains("\"orchestrator\"") {
        assert!(begun.elapsed() < Duration::from_secs(60), "the run has not begun");
        std::thread::sleep(Duration::from_millis(20));
    }
    // Long enough for the run to find all walks ended and no job to lease.
    std::thread::sleep(Duration::from_millis(1500));
    assert!(running.0.try_wait().unwrap().is_none(), "it waits for the label");
    signal(running.0.id(), "INT");
    assert_eq!(running.0.wait().unwrap().code(), Some(130));
}
