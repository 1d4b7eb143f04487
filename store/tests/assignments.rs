//! Records of assignments and reference volumes: written with their commit, verified, copied, and absent in earlier versions.

use store::{
    AssignmentRecord, Commit, Location, ProcessRecord, Store, TotalThroughput, WalkProgressRecord,
    WalkRecord, unix_milliseconds,
};
use wire::WalkId;
use wire::messages::{AssignmentStart, DeclineReason, PathPosition, Verdict, WalkProgress};

use crate::common::*;

pub fn assignment(walk: u32, part: u64) -> AssignmentRecord {
    let at = |step| PathPosition {
        segment: (part / 3) as u32,
        step,
        reference_step: (part == 0).then_some(7 * (step + 1)),
    };
    let verdict = match part % 3 {
        0 => None,
        1 => Some(Verdict::Accepted),
        _ => Some(Verdict::Declined(DeclineReason::Covered)),
    };
    AssignmentRecord {
        walk: WalkId(walk),
        part,
        number: part / 2,
        start: AssignmentStart {
            position: at(10 * part),
            mixture_version: 3 * part,
            threshold_factor: 1.0 + 0.25 * part as f64,
            verdict,
        },
        end: at(10 * part + 9),
    }
}

fn with_volume(number: u32, reference_volume: Option<f64>) -> WalkRecord {
    let plain = walk(number, 1);
    WalkRecord { accepted: 0, progress: WalkProgress { reference_volume, ..plain.progress.clone() }, ..plain }
}

async fn volumes(store: &Store) -> Vec<Option<f64>> {
    store.status().await.unwrap().walks.iter().map(|walk| walk.reference_volume).collect()
}

#[tokio::test]
async fn assignments_are_written_verified_and_copied() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let first = vec![assignment(0, 0), assignment(1, 0), assignment(0, 1)];
    let walks = vec![with_volume(0, Some(540.25)), with_volume(1, None)];
    store.commit(&Commit { assignments: first, walks, ..Commit::default() }).await.unwrap();
    // V₀ is written once.
    let walks = vec![with_volume(0, Some(1.0))];
    let assignments = vec![assignment(0, 2), assignment(0, 3)];
    store.commit(&Commit { assignments, walks, ..Commit::default() }).await.unwrap();
    let expected: Vec<_> = (0..4).map(|part| assignment(0, part)).collect();
    assert_eq!(store.assignments(WalkId(0)).await.unwrap(), expected);
    assert_eq!(store.assignments(WalkId(1)).await.unwrap(), [assignment(1, 0)]);
    assert_eq!(store.assignments(WalkId(2)).await.unwrap(), []);
    assert_eq!(volumes(&store).await, [Some(540.25), None]);
    assert_eq!(store.check(|_, _| {}).await.unwrap(), []);

    let copies = tempfile::tempdir().unwrap();
    let copy = copies.path().join("copy");
    store.backup(&copy, 3, |_, _| {}).await.unwrap();
    store.close().await;
    let copied = Store::open(copy.as_path()).await.unwrap();
    assert_eq!(copied.assignments(WalkId(0)).await.unwrap(), expected);
    assert_eq!(volumes(&copied).await, [Some(540.25), None]);
    copied.close().await;

    for damage in [
        "UPDATE assignment SET mixture_version = 4 WHERE walk = 0 AND part = 1",
        "UPDATE assignment SET verdict = NULL WHERE walk = 0 AND part = 2",
        "UPDATE assignment SET walk = 7 WHERE walk = 1",
        "UPDATE reference_volume SET volume = 541",
    ] {
        database.execute(damage).await;
    }
    let store = database.open().await;
    let found = store.check(|_, _| {}).await.unwrap();
    assert_eq!(found.len(), 4, "{found:?}");
    assert!(store.assignments(WalkId(0)).await.is_err());
    store.close().await;
}

#[tokio::test]
async fn tables_of_version_19_have_no_assignments() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let walks = vec![with_volume(0, None)];
    store.commit(&Commit { walks, ..Commit::default() }).await.unwrap();
    store.close().await;
    database.execute(TO_VERSION_19).await;
    if let Location::Directory(_) = database.location() {
        database.execute("PRAGMA user_version = 19").await;
    }
    let store = database.open_read_only().await;
    assert_eq!(store.assignments(WalkId(0)).await.unwrap(), []);
    assert_eq!(volumes(&store).await, [None]);
    assert_eq!(store.check(|_, _| {}).await.unwrap(), []);
    store.close().await;
    let store = database.open().await;
    let assignments = vec![assignment(0, 0)];
    store.commit(&Commit { assignments: assignments.clone(), ..Commit::default() }).await.unwrap();
    assert_eq!(store.assignments(WalkId(0)).await.unwrap(), assignments);
    let progress = WalkProgressRecord { seen: 1, reference_step: Some(9), ..Default::default() };
    store.set_walk_progress(&[progress], TotalThroughput::default(), 1).await.unwrap();
    store.close().await;
}

#[tokio::test]
async fn a_walk_in_its_reference_run_shows_its_steps_there() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let now = unix_milliseconds();
    let process = ProcessRecord {
        id: "run".into(),
        kind: "orchestrator".into(),
        pid: std::process::id(),
        host: store::this_host(),
        started: now,
        last_seen: now,
        state: "running".into(),
        ..ProcessRecord::default()
    };
    store.upsert_process(&process).await.unwrap();
    let begun = WalkRecord { progress: WalkProgress::default(), ..with_volume(0, None) };
    store.commit(&Commit { walks: vec![begun], ..Commit::default() }).await.unwrap();
    let (reference_step, steps_per_second) = (Some(3200), Some(25.0));
    let record = WalkProgressRecord { seen: now, reference_step, steps_per_second, ..Default::default() };
    store.set_walk_progress(&[record], TotalThroughput::default(), now).await.unwrap();
    let shown = async || {
        let walk = store.status().await.unwrap().walks.remove(0);
        (walk.step, walk.reference_step, walk.reference_volume, walk.steps_per_second)
    };
    assert_eq!(shown().await, (0, Some(3200), None, Some(25.0)));
    // The report after its end is newer than the last progress.
    let walks = vec![with_volume(0, Some(540.25))];
    store.commit(&Commit { walks, ..Commit::default() }).await.unwrap();
    assert_eq!(shown().await, (100, None, Some(540.25), Some(25.0)));
    store.close().await;
}
