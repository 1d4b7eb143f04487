//! `calmwalk store`: backups of a running campaign are complete or do not exist. `CALMWALK_POSTGRES` runs the same tests on a
//! server.

use std::fs;
use std::path::Path;
use std::time::Instant;

use serde_json::Value;
use store::Location;

use crate::common;
use crate::common::campaign::{Small, outcome, outcome_at};
use crate::common::label_campaign::{LabelCampaign, on_store};
use crate::common::processes::{pause_walkers, processes_in, wait_until};
use crate::common::{calmwalk, kills, random, refuse, stderr, succeed};

fn ended(running: &mut common::Running) -> Option<i32> {
    running.0.wait().expect("a child").code()
}

/// The entries of a directory except hidden ones.
fn visible(directory: &Path) -> Vec<String> {
    let names =
        fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names.filter(|name| !name.starts_with('.')).collect()
}

/// A copy made during a campaign continues to the same outcome as the campaign.
#[test]
fn a_copy_of_a_running_campaign_can_be_continued() {
    // Some seconds of work, so that it runs while it is copied.
    let small = Small { steps: 600, max_per_walk: 1000, ..Small::default() };
    let place = LabelCampaign::new(&small, &[]);
    let elsewhere = tempfile::tempdir().unwrap();
    let copy = elsewhere.path().join("copy").display().to_string();
    let mut run = place.run();
    wait_until("the campaign advances", || {
        place.status()["mixture_version"].as_u64().is_some_and(|version| version > 0)
    });
    // The campaign must not end before it is copied, nor before the commands that are refused while it runs.
    let held = pause_walkers(place.path(), small.walkers);
    let said = succeed(place.path(), ["store", "backup", place.argument(), &copy]);
    assert!(said.contains("backed up to "), "{said}");
    assert_eq!(visible(elsewhere.path()), ["copy"]);
    let message = refuse(place.path(), ["store", "backup", place.argument(), &copy]);
    assert!(message.contains("exists already: give the backup a new directory"), "{message}");
    let message = refuse(place.path(), ["store", "compact", place.argument()]);
    assert!(message.contains("is being run by process"), "{message}");
    held.resume();
    let said = succeed(place.path(), ["store", "check", &copy]);
    assert!(said.contains("no problems found in "), "{said}");
    let status: Value = serde_json::from_str(&succeed(place.path(), ["status", &copy, "--json"])).unwrap();
    assert_eq!((&status["processes"], &status["finished"]), (&serde_json::json!([]), &false.into()));
    assert_eq!(ended(&mut run), Some(0), "{}", place.said());

    let text = fs::read_to_string(place.path().join("campaign.toml")).unwrap();
    let lines = text.lines().filter(|line| !line.starts_with("store = "));
    fs::write(place.path().join("campaign.toml"), lines.collect::<Vec<_>>().join("\n")).unwrap();
    succeed(place.path(), ["run", "campaign.toml", "--directory", &copy]);
    assert_eq!(outcome(Path::new(&copy)), outcome_at(place.argument(), place.path()));
}

#[test]
fn a_killed_backup_leaves_nothing_that_looks_like_one() {
    let small = Small { steps: 60, ..Small::default() };
    let place = LabelCampaign::new(&small, &[]);
    assert_eq!(ended(&mut place.run()), Some(0), "{}", place.said());
    // Enough data for a copy to take some time.
    on_store(place.location(), async |store| {
        for slot in 100..140 {
            let bytes = (0..1_000_000u64).map(|n| random(n + slot) as u8).collect();
            let component = store::ComponentRecord { element: 0, slot: slot as u32, bytes };
            let commit = store::Commit { components: vec![component], ..store::Commit::default() };
            store.commit(&commit).await.unwrap();
        }
    });
    let exported = place.export();
    let elsewhere = tempfile::tempdir().unwrap();
    let target = elsewhere.path().join("copy");
    let copy = target.display().to_string();
    let begun = Instant::now();
    succeed(place.path(), ["store", "backup", place.argument(), &copy]);
    let takes = begun.elapsed();
    fs::remove_dir_all(&target).unwrap();
    let (mut unfinished, mut whole) = (0, 0);
    for kill in 0..kills() {
        let mut backup = place.start(&["store", "backup", place.argument(), &copy]);
        std::thread::sleep(takes.mul_f64((random(kill) % 1000) as f64 / 1000.0));
        backup.0.kill().unwrap();
        backup.0.wait().unwrap();
        if target.exists() {
            assert_eq!(visible(elsewhere.path()), ["copy"]);
            on_store(Location::from(&target), async |store| {
                assert_eq!(store.load_components().await.unwrap().last().unwrap().bytes.len(), 1_000_000);
            });
            fs::remove_dir_all(&target).unwrap();
            whole += 1;
        } else {
            unfinished += fs::read_dir(elsewhere.path()).unwrap().count();
            assert_eq!(visible(elsewhere.path()), [""; 0]);
        }
    }
    assert!(unfinished > 0, "none of {} was killed while it copied, {whole} were complete", kills());
    succeed(place.path(), ["store", "backup", place.argument(), &copy]);
    assert_eq!(fs::read_dir(elsewhere.path()).unwrap().count(), 1, "the unfinished backups are removed");
    succeed(place.path(), ["export", &copy, "--control", "--output", "copy.extxyz"]);
    assert_eq!(fs::read(place.path().join("copy.extxyz")).unwrap(), exported);
}

#[test]
fn check_and_compact_report_what_they_find() {
    let small = Small { steps: 60, ..Small::default() };
    let place = LabelCampaign::new(&small, &[]);
    assert_eq!(ended(&mut place.run()), Some(0), "{}", place.said());
    let said = succeed(place.path(), ["store", "check", place.argument()]);
    assert!(said.starts_with("no problems found in "), "{said}");
    let said = succeed(place.path(), ["store", "compact", place.argument()]);
    assert!(said.contains(" MB before, ") && said.contains(" MB after"), "{said}");
    let output = calmwalk(place.path(), ["store", "compact", place.argument(), "--drop-declined-features"]);
    assert!(stderr(&output).contains("calmwalk replay --set stops at the first of them"));
    succeed(place.path(), ["store", "check", place.argument()]);
    wait_until("all processes have exited", || processes_in(place.path()).is_empty());
    on_store(place.location(), async |store| {
        let bytes = b"no component".to_vec();
        let component = store::ComponentRecord { element: 0, slot: 7, bytes };
        let commit = store::Commit { components: vec![component], ..store::Commit::default() };
        store.commit(&commit).await.unwrap();
    });
    let output = calmwalk(place.path(), ["store", "check", place.argument()]);
    let said = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(1));
    assert!(
        said.contains("component 7 of element 0 cannot be read (") && said.contains("restore the campaign"),
        "{said}"
    );
    assert!(stderr(&output).contains("1 findings in "), "{}", stderr(&output));
    let status = place.status();
    let (bytes, forecast) = (status["disk"]["bytes"].as_u64(), &status["disk"]["forecast"]);
    assert!(bytes.unwrap() > 100_000 && forecast["structures"].as_u64().unwrap() > 0, "{status}");
}

/// `store check` reports damage that SQLite's own check finds.
#[test]
fn a_damaged_file_is_found() {
    let small = Small { steps: 60, ..Small::default() };
    let place = LabelCampaign::new(&small, &[]);
    if place.argument() != "." {
        // A server checks its own files.
        return;
    }
    assert_eq!(ended(&mut place.run()), Some(0), "{}", place.said());
    let path = place.path().join("campaign.sqlite");
    let whole = fs::read(&path).unwrap();
    const PAGE: usize = 1 << 14;
    for page in [whole.len() / PAGE / 2, whole.len() / PAGE - 1] {
        let mut damaged = whole.clone();
        damaged[page * PAGE..(page + 1) * PAGE].fill(0x5a);
        fs::write(&path, damaged).unwrap();
        let output = calmwalk(place.path(), ["store", "check", "."]);
        let said = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "page {page}: {said}");
        assert!(said.contains("restore the campaign from a backup"), "{said}");
    }
}
