//! Leases across hosts: no job is leased twice, and only the server's clock counts.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use sqlx::Executor;
use store::{CompleteOutcome, Fate, JobState, Lease, ProcessRecord, Store};
use wire::Origin;

use super::common::*;
use super::leading::connect;

const HOUR: i64 = 3_600_000;

async fn lease(store: &Store, holder: &str, now: i64, seconds: u32) -> Option<Lease> {
    store.lease(protocol("dft").hash, holder, now, seconds).await.unwrap()
}

/// A campaign with this many jobs that uses the server's clock.
async fn with_jobs(database: &TestDatabase, jobs: u64) -> Store {
    let store = database.create().await;
    let records = (1..=jobs).map(|step| candidate(0, step, Origin::Biased, Fate::Accepted)).collect();
    store.commit(&commit_of(records)).await.unwrap();
    Store::open(database.location()).await.unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn eight_labellers_at_once_never_get_the_same_job() {
    let database = TestDatabase::new();
    let store = with_jobs(&database, 200).await;
    let labeller = |number: usize| {
        let location = database.location();
        tokio::spawn(async move {
            let store = Store::open(location).await.unwrap();
            let mut jobs = Vec::new();
            while let Some(lease) = lease(&store, &format!("l{number}"), 0, 600).await {
                assert_eq!(lease.attempt, 1);
                jobs.push(lease.job);
                if lease.job % 2 == 0 {
                    assert_eq!(
                        store.complete(&lease, &label(-1.0), 1).await.unwrap(),
                        CompleteOutcome::Label
                    );
                }
            }
            jobs
        })
    };
    let labellers: Vec<_> = (0..8).map(labeller).collect();
    let (mut all, mut distinct) = (0, BTreeSet::new());
    for labeller in labellers {
        let jobs = labeller.await.unwrap();
        all += jobs.len();
        distinct.extend(jobs);
    }
    assert_eq!((all, distinct.len()), (200, 200));
    let labels = store.status().await.unwrap().labels;
    assert_eq!((labels.queued, labels.leased + labels.labelled), (0, 200));
}

/// A job that is being leased does not block the next one.
#[tokio::test]
async fn a_job_locked_by_another_is_skipped() {
    let database = TestDatabase::new();
    let store = with_jobs(&database, 2).await;
    let mut other = connect(&database).await;
    other.execute("BEGIN; SELECT number FROM job ORDER BY decision LIMIT 1 FOR UPDATE").await.unwrap();
    let leased = tokio::time::timeout(Duration::from_secs(5), lease(&store, "a", 0, 600)).await;
    assert_eq!(leased.unwrap().unwrap().structure, structure(2e-6));
    assert!(lease(&store, "a", 0, 600).await.is_none());
    other.execute("ROLLBACK").await.unwrap();
    assert_eq!(lease(&store, "a", 0, 600).await.unwrap().structure, structure(1e-6));
}

#[tokio::test]
async fn labellers_with_clocks_an_hour_apart_respect_each_others_leases() {
    let database = TestDatabase::new();
    let (store, now) = (with_jobs(&database, 2).await, store::unix_milliseconds());
    let slow = lease(&store, "slow", now - HOUR, 600).await.unwrap();
    let fast = lease(&store, "fast", now + HOUR, 600).await.unwrap();
    assert!(lease(&store, "fast", now + HOUR, 600).await.is_none(), "the slow one's lease lasts");
    assert!(store.renew(&slow, now - HOUR, 600).await.unwrap());
    assert!(lease(&store, "fast", now + HOUR, 600).await.is_none());
    for job in store.queue_list(Some(JobState::Leased), 9, 0).await.unwrap() {
        let left = job.expires.unwrap() - now;
        assert!((590_000..700_000).contains(&left), "{left} ms left of {job:?}");
    }
    assert_eq!(store.complete(&fast, &label(-1.0), now + HOUR).await.unwrap(), CompleteOutcome::Label);

    // A silent process loses its lease whatever its clock shows: the server wrote the time of its record.
    let elsewhere = |id: &str, last_seen| {
        let here = ProcessRecord { id: id.into(), ..ProcessRecord::new("labeller", Some(7), 1, last_seen) };
        let start_time = store::process_start_time(std::process::id()).unwrap();
        let (place, ticks) = start_time.rsplit_once('/').unwrap();
        ProcessRecord { start_time: format!("{place}0/{ticks}"), ..here }
    };
    assert!(store.renew(&slow, now - HOUR, 1).await.unwrap());
    let started = Instant::now();
    store.upsert_process(&elsewhere("slow", now + HOUR)).await.unwrap();
    let again = loop {
        if let Some(lease) = lease(&store, "fast", now - HOUR, 1).await {
            break lease;
        }
        assert!(started.elapsed() < Duration::from_secs(60), "the silent one keeps its job for ever");
        tokio::time::sleep(Duration::from_millis(50)).await;
    };
    assert_eq!((again.job, again.attempt), (slow.job, 2));
    assert!(started.elapsed() >= Duration::from_millis(900), "not before a second of silence");
}

#[tokio::test]
async fn a_label_delivered_after_its_lease_was_lost_counts_once() {
    let database = TestDatabase::new();
    let store = with_jobs(&database, 1).await;
    let late = lease(&store, "late", 0, 1).await.unwrap();
    tokio::time::sleep(Duration::from_millis(1100)).await;
    let holds = lease(&store, "holds", 0, 600).await.unwrap();
    assert_eq!((holds.job, holds.attempt), (late.job, 2));
    assert!(!store.renew(&late, 0, 600).await.unwrap());
    assert_eq!(store.complete(&late, &label(-1.0), 0).await.unwrap(), CompleteOutcome::Label);
    assert_eq!(store.complete(&holds, &label(-2.0), 0).await.unwrap(), CompleteOutcome::KeptAsCheck);
    assert_eq!(store.complete(&late, &label(-3.0), 0).await.unwrap(), CompleteOutcome::Label);
    let details = store.queue_show(&late.candidate).await.unwrap();
    let energies: Vec<_> = details.energies.iter().map(|(_, energy)| *energy).collect();
    assert_eq!((details.job.state, energies), (JobState::Labelled, vec![-1.0, -2.0]));
}

#[tokio::test]
async fn waiting_labellers_are_notified_of_new_jobs() {
    let database = TestDatabase::new();
    let store = with_jobs(&database, 1).await;
    let long = Duration::from_secs(60);
    // Until it listens.
    store.wait_for_jobs(long).await;
    let (waiting, started) = (store.clone(), Instant::now());
    let wait = tokio::spawn(async move { waiting.wait_for_jobs(long).await });
    tokio::time::sleep(Duration::from_millis(100)).await;
    store.commit(&commit_of(vec![candidate(1, 1, Origin::Biased, Fate::Accepted)])).await.unwrap();
    wait.await.unwrap();
    assert!(started.elapsed() < long / 2);
    // Notified once; a job that returns to the queue causes a notification as well.
    tokio::time::timeout(Duration::from_millis(300), store.wait_for_jobs(long)).await.unwrap_err();
    let leased = lease(&store, "a", 0, 600).await.unwrap();
    store.release_all("a", 0).await.unwrap();
    store.wait_for_jobs(long).await;
    assert!(started.elapsed() < long / 2);
    assert_eq!(lease(&store, "b", 0, 600).await.unwrap().job, leased.job);
}

/// The output of a process may contain anything.
#[tokio::test]
async fn nul_characters_in_a_log_are_replaced() {
    let database = TestDatabase::new();
    let store = with_jobs(&database, 1).await;
    let leased = lease(&store, "a", 0, 600).await.unwrap();
    store.fail(&leased, "crashed", "a\0b", 3, 0).await.unwrap();
    let details = store.queue_show(&leased.candidate).await.unwrap();
    assert_eq!(details.attempts_made[0].log.as_deref(), Some("a\u{fffd}b"));
}
