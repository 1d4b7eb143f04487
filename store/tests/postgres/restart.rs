//! Restarts the server during work, as after a crash: nothing is lost or duplicated. Run it separately, because no other test
//! can use the server at the same time:
//! `CALMWALK_POSTGRES=$(.ci/postgres start) cargo test -p store --test postgres restart::`.

use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use store::{CampaignLock, Commit, CompleteOutcome, ComponentRecord, Fate, JobState, Store, StoreError};
use wire::Origin;
use wire::messages::DeclineReason;

use crate::common::*;

const RESTARTS: u64 = 4;
const LABELLERS: usize = 3;

fn restart() {
    let command = std::env::var("CALMWALK_POSTGRES_RESTART")
        .unwrap_or_else(|_| concat!(env!("CARGO_MANIFEST_DIR"), "/../.ci/postgres crash").into());
    assert!(Command::new("sh").args(["-c", &command]).status().unwrap().success(), "{command}");
}

/// Commit `k`, from 1; all its parts contain `k`.
fn numbered(k: u64) -> Commit {
    let records = vec![
        candidate(0, 2 * k, Origin::Biased, Fate::Accepted),
        candidate(0, 2 * k + 1, Origin::Biased, Fate::Declined(DeclineReason::Covered)),
    ];
    Commit {
        components: vec![ComponentRecord { element: 0, slot: 0, bytes: k.to_le_bytes().to_vec() }],
        walks: vec![walk(0, k)],
        values: vec![("commits".into(), k.to_string())],
        ..commit_of(records)
    }
}

/// Retries until the server responds.
async fn retry_until_answered<T, F: Future<Output = Result<T, StoreError>>>(
    mut call: impl FnMut() -> F,
) -> T {
    loop {
        match call().await {
            Err(error) if error.is_transient() => tokio::time::sleep(Duration::from_millis(20)).await,
            done => return done.unwrap(),
        }
    }
}

/// Labels until no more jobs will come. Returns the number of accepted labels.
async fn label_all(store: Store, number: usize, no_more_jobs: Arc<AtomicBool>) -> u64 {
    let (holder, mut labelled) = (format!("l{number}"), 0);
    loop {
        let last_look = no_more_jobs.load(Ordering::Relaxed);
        let found = retry_until_answered(|| store.lease(protocol("dft").hash, &holder, 0, 1)).await;
        let Some(lease) = found else {
            // A lease whose reply was lost is released when it expires.
            if last_look && retry_until_answered(|| store.unfinished_jobs()).await == 0 {
                return labelled;
            }
            store.wait_for_jobs(Duration::from_millis(50)).await;
            continue;
        };
        let made = label(-1.0);
        if retry_until_answered(|| store.complete(&lease, &made, 0)).await == CompleteOutcome::Label {
            labelled += 1;
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_is_lost_or_duplicated_when_the_server_restarts() {
    let database = TestDatabase::new();
    let lock = CampaignLock::acquire_at(database.location(), "restart test").await.unwrap();
    drop(database.create().await);
    let store = Store::open(database.location()).await.unwrap().fenced_by(&lock);
    let (done, committed) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
    let no_more_jobs = Arc::new(AtomicBool::new(false));
    let labellers: Vec<_> = (0..LABELLERS)
        .map(|number| tokio::spawn(label_all(store.clone(), number, Arc::clone(&no_more_jobs))))
        .collect();
    let committing = tokio::spawn({
        let (store, done, committed) = (store.clone(), Arc::clone(&done), Arc::clone(&committed));
        async move {
            for k in 1.. {
                // Each call is made once: the store waits for the server.
                let numbers = store.commit(&numbered(k)).await.unwrap();
                assert_eq!(numbers, 2 * k as i64 - 1..2 * k as i64 + 1);
                committed.store(k, Ordering::Relaxed);
                if done.load(Ordering::Relaxed) {
                    return k;
                }
            }
            unreachable!("it commits without end")
        }
    });
    for _ in 0..RESTARTS {
        let before = committed.load(Ordering::Relaxed);
        while committed.load(Ordering::Relaxed) < before + 5 {
            assert!(!committing.is_finished(), "it commits until the server confirms it");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        tokio::task::spawn_blocking(restart).await.unwrap();
    }
    done.store(true, Ordering::Relaxed);
    let commits = committing.await.unwrap();
    no_more_jobs.store(true, Ordering::Relaxed);
    for labeller in labellers {
        labeller.await.unwrap();
    }

    let decisions = store.decisions(1..=i64::MAX).await.unwrap();
    let expected: Vec<_> = (1..=commits).flat_map(|k| numbered(k).candidates).map(|c| name_of(&c)).collect();
    let found: Vec<_> = decisions.into_iter().filter_map(|decision| decision.candidate).collect();
    assert_eq!(found, expected);
    assert_eq!(store.load_walks().await.unwrap(), numbered(commits).walks);
    assert_eq!(store.load_components().await.unwrap(), numbered(commits).components);
    let jobs = store.queue_list(None, u32::MAX, 0).await.unwrap();
    assert_eq!(jobs.len() as u64, commits);
    for job in jobs {
        assert_eq!(job.state, JobState::Labelled);
        let details = store.queue_show(&job.candidate).await.unwrap();
        let labels = details.energies.iter().filter(|(status, _)| *status == store::LabelStatus::Label);
        assert_eq!(labels.count(), 1);
        assert_eq!(details.attempts_made.len() as u32, job.attempts);
        assert!(details.attempts_made.iter().all(|attempt| attempt.outcome.is_some()));
    }
    // The store reacquired the lock, which no other process held.
    let lost = tokio::time::timeout(Duration::from_secs(3), lock.lost()).await;
    assert!(lost.is_err(), "{lost:?}");
    let error = CampaignLock::acquire_at(database.location(), "second").await.unwrap_err();
    assert!(matches!(error, StoreError::Locked { .. }), "{error}");
}
