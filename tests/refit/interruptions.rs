//! A refit that is killed at any instant of its steps gives the same bytes in the end.

use std::time::{Duration, Instant};

use super::*;
use crate::common::random;

/// The steps of a refit: a name, the file with which each begins, and that with which it ends. The last ends with the record.
const STEPS: [(&str, &str, &str); 4] = [
    ("training", "labels.json", "training.json"),
    ("judging", "training.json", "errors.json"),
    ("building", "errors.json", "mixture.npz"),
    // Models for comparison are trained before the version is recorded.
    ("registering", "mixture.npz", ""),
];
/// Kills of each step.
const KILLS: usize = 3;

/// Waits until the file is there, with a shorter interval than [`wait_until`]; false if the process has ended before.
fn wait_for(file: &Path, child: &mut Child) -> bool {
    loop {
        if file.exists() {
            return true;
        }
        if child.try_wait().unwrap().is_some() {
            return file.exists();
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// How long each step of an uninterrupted refit takes.
fn durations(here: &Path, settings: &Json, directory: &Path) -> Vec<Duration> {
    let mut running = Running(start(here, settings));
    let mut begins = Vec::new();
    for (_, begin, _) in STEPS {
        assert!(wait_for(&directory.join(begin), &mut running.0), "no {begin}");
        begins.push(Instant::now());
    }
    assert_eq!(running.0.wait().unwrap().code(), Some(0));
    begins.push(Instant::now());
    begins.windows(2).map(|pair| pair[1] - pair[0]).collect()
}

/// Kills a refit this long after a step has begun. Returns whether it was in that step.
fn kill_within(here: &Path, settings: &Json, directory: &Path, step: usize, after: Duration) -> bool {
    let (_, begin, end) = STEPS[step];
    let mut running = Running(start(here, settings));
    wait_for(&directory.join(begin), &mut running.0);
    std::thread::sleep(after);
    let is_running = running.0.try_wait().unwrap().is_none();
    signal(running.0.id(), "KILL");
    running.0.wait().unwrap();
    is_running && directory.join(begin).exists() && (end.is_empty() || !directory.join(end).exists())
}

#[test]
fn a_refit_that_is_killed_in_any_step_registers_the_same_bytes() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    let native = json!({ "native": { "epochs": 3, "learning_rate": 1e-4, "validation_share": 0.0 } });
    let of = |campaign: &str| {
        let mut wanted = settings(here, campaign, native.clone());
        wanted["settings"]["comparisons"] =
            json!([{ "name": "known", "file": hashed(here.join("test.extxyz")) }]);
        wanted
    };
    copy(&here.join("campaign"), &here.join("0"));
    let times = durations(here, &of("campaign"), &here.join("campaign/refit/1"));
    let version = |campaign: &str| {
        let all = versions(&here.join(campaign));
        let [version] = &all[..] else { panic!("one version: {all:?}") };
        let version = VersionRecord { seconds: 0.0, core_hours: 0.0, time: 0, ..version.clone() };
        (version, files(&here.join(campaign), 1))
    };
    let expected = version("campaign");
    assert_eq!(expected.0.state, VersionState::Registered, "{}", expected.0.reason);

    // A busy host may miss a short step: then another refit is begun.
    let (mut hits, mut attempts) = ([0; STEPS.len()], 0);
    while hits.contains(&0) || hits.iter().sum::<usize>() < 10 {
        assert!(attempts < 5, "kills in each step: {hits:?}, which take {times:?}");
        let name = format!("{attempts}");
        copy(&here.join(&name), &here.join(format!("{}", attempts + 1)));
        let (wanted, place) = (of(&name), here.join(&name).join("refit/1"));
        for step in 0..STEPS.len() {
            for kill in 0..KILLS {
                let part = (random((100 * attempts + 10 * step + kill) as u64) % 900) as f64 / 1000.0;
                // The host may have been busier when the steps were measured.
                let after = times[step].mul_f64(part / f64::from(1_u32 << attempts));
                hits[step] += usize::from(kill_within(here, &wanted, &place, step, after));
            }
        }
        let output = refit(here, &wanted);
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        assert!(version(&name) == expected, "another version after kills in each step: {hits:?}");
        attempts += 1;
    }
}
