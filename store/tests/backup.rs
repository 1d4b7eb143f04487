//! Backups of running campaigns.

use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use store::{Commit, ComponentRecord, ExportFilter, Fate, JobState, ProcessRecord, Store, StoreError};
use wire::Origin;
use wire::messages::DeclineReason;

use crate::common::*;

/// The commit with number `k`, from 1, of walk `k`.
fn numbered(k: u32) -> Commit {
    let records = vec![
        candidate(k, 1, Origin::Biased, Fate::Accepted),
        candidate(k, 2, Origin::Biased, Fate::Declined(DeclineReason::Covered)),
    ];
    Commit {
        components: vec![ComponentRecord { element: 0, slot: 0, bytes: k.to_le_bytes().to_vec() }],
        walks: vec![walk(k, 1)],
        values: vec![("commits".into(), k.to_string())],
        ..commit_of(records)
    }
}

async fn contents(store: &Store) -> (String, String, String) {
    let filter = ExportFilter { protocol: protocol("dft").hash, biased: true, control: true, imported: true };
    (
        store.decision_log_text().await.unwrap(),
        format!("{:?} {:?}", store.load_walks().await.unwrap(), store.load_components().await.unwrap()),
        format!(
            "{:?} {:?}",
            store.values().await.unwrap(),
            store.labelled(&filter, None, 1000).await.unwrap()
        ),
    )
}

async fn back_up(store: &Store, target: &Path) -> Result<(), StoreError> {
    store.backup(target, 7, |done, all| assert!(done <= all, "{done} of {all}")).await
}

#[tokio::test]
async fn a_backup_is_an_independent_campaign() {
    let (database, elsewhere) = (TestDatabase::new(), tempfile::tempdir().unwrap());
    let store = database.create().await;
    for k in 1..=200 {
        store.commit(&numbered(k)).await.unwrap();
    }
    let process = ProcessRecord::new("labeller", Some(0), std::process::id(), 1);
    store.upsert_process(&process).await.unwrap();
    let lease = async || store.lease(protocol("dft").hash, &process.id, 1, 600).await.unwrap().unwrap();
    store.complete(&lease().await, &label(-3.0), 2).await.unwrap();
    let leased = lease().await;
    let target = elsewhere.path().join("copy");
    back_up(&database.open_read_only().await, &target).await.unwrap();
    assert_eq!(fs::read_dir(elsewhere.path()).unwrap().count(), 1);
    let copy = Store::open(&target).await.unwrap();
    assert_eq!(contents(&copy).await, contents(&store).await);
    assert_eq!(copy.campaign().await.unwrap(), store.campaign().await.unwrap());
    assert_eq!(copy.seed_structures().await.unwrap(), store.seed_structures().await.unwrap());
    assert_eq!(copy.candidates(0, true, 500).await.unwrap().len(), 400);
    assert_eq!(copy.check(|_, _| ()).await.unwrap(), []);
    // The original's processes stay registered.
    assert_eq!(copy.processes(None).await.unwrap(), []);
    assert_eq!(store.processes(None).await.unwrap().len(), 1);
    let job = copy.queue_show(&leased.candidate).await.unwrap();
    assert_eq!(
        (job.job.state, job.attempts_made[0].outcome.as_deref()),
        (JobState::Queued, Some("released"))
    );
    assert_eq!(store.queue_show(&leased.candidate).await.unwrap().job.state, JobState::Leased);
    assert_eq!(copy.operations(0, 100).await.unwrap().pop().unwrap().kind, "copied");
    // The copy continues independently.
    copy.commit(&numbered(201)).await.unwrap();
    let again = copy.lease(protocol("dft").hash, "other", 9, 600).await.unwrap().unwrap();
    assert_eq!((again.job, again.attempt), (leased.job, 2));
}

#[tokio::test]
async fn nothing_is_overwritten() {
    let (database, elsewhere) = (TestDatabase::new(), tempfile::tempdir().unwrap());
    let store = database.create().await;
    for name in ["file", "directory"] {
        let target = elsewhere.path().join(name);
        if name == "file" {
            fs::write(&target, "mine").unwrap()
        } else {
            fs::create_dir(&target).unwrap()
        }
        let error = back_up(&store, &target).await.unwrap_err();
        assert!(matches!(error, StoreError::BackupExists { .. }), "{error}");
    }
    assert_eq!(fs::read_to_string(elsewhere.path().join("file")).unwrap(), "mine");
    let missing = elsewhere.path().join("missing/copy");
    assert!(matches!(back_up(&store, &missing).await, Err(StoreError::Directory { .. })));
    assert_eq!(fs::read_dir(elsewhere.path()).unwrap().count(), 2);
}

/// A copy is complete at any time.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn backups_are_made_while_the_campaign_runs() {
    let (database, elsewhere) = (TestDatabase::new(), tempfile::tempdir().unwrap());
    let (store, stop) = (database.create().await, Arc::new(AtomicBool::new(false)));
    let committing = tokio::spawn({
        let (store, stop) = (store.clone(), Arc::clone(&stop));
        async move {
            for k in 1.. {
                store.commit(&numbered(k)).await.unwrap();
                if stop.load(Ordering::Relaxed) {
                    return k;
                }
            }
            unreachable!("it commits without end")
        }
    });
    let mut before = 0;
    for number in 0..5 {
        let target = elsewhere.path().join(number.to_string());
        back_up(&database.open_read_only().await, &target).await.unwrap();
        let copy = Store::open_read_only(&target).await.unwrap();
        assert_eq!(copy.check(|_, _| ()).await.unwrap(), []);
        let values = copy.values().await.unwrap();
        let commits: u32 = values.first().map_or(0, |(_, value)| value.parse().unwrap());
        assert_eq!(copy.decisions(1..=i64::MAX).await.unwrap().len() as u32, 2 * commits);
        assert_eq!(copy.load_walks().await.unwrap().len() as u32, commits);
        assert!(commits >= before);
        before = commits;
    }
    stop.store(true, Ordering::Relaxed);
    assert!(committing.await.unwrap() > 5, "it committed meanwhile");
}

#[tokio::test]
async fn compacting_frees_space_and_changes_nothing() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let long = |k: u32, length: usize| {
        let bytes = (0..length).map(|n| (n as u32).wrapping_mul(k) as u8).collect();
        Commit { components: vec![ComponentRecord { element: 0, slot: k, bytes }], ..Commit::default() }
    };
    for k in 0..20 {
        store.commit(&long(k, 200_000)).await.unwrap();
    }
    for k in 0..20 {
        store.commit(&long(k, 10)).await.unwrap();
    }
    store.commit(&numbered(1)).await.unwrap();
    let (before, size) = (contents(&store).await, store.size().await.unwrap());
    // On a server, rows that another transaction may still see stay; other tests hold some.
    let started = Instant::now();
    loop {
        store.compact().await.unwrap();
        let compacted = store.size().await.unwrap();
        if compacted + 3_000_000 < size {
            break;
        }
        assert!(started.elapsed() < Duration::from_secs(60), "{compacted} of {size}");
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
    assert_eq!(contents(&store).await, before);
    let features = async |k: usize| store.candidates(0, true, 9).await.unwrap().swap_remove(k).features;
    assert!(features(0).await.is_some() && features(1).await.is_some());
    assert_eq!(store.drop_declined_features(3).await.unwrap(), 1);
    assert!(features(0).await.is_some() && features(1).await.is_none());
    assert_eq!(store.drop_declined_features(3).await.unwrap(), 0);
}
