//! Processes of a campaign, and the leases of dead ones.

use store::{JobState, Lease, ProcessRecord, Store, process_start_time};

use crate::common::*;

/// A living process (this one).
fn living(id: &str, kind: &str, number: Option<u32>) -> ProcessRecord {
    ProcessRecord { id: id.into(), ..ProcessRecord::new(kind, number, std::process::id(), 1) }
}

/// Its process id belongs to another process now.
fn gone(id: &str, kind: &str, number: Option<u32>) -> ProcessRecord {
    let living = living(id, kind, number);
    ProcessRecord { start_time: format!("{}0", living.start_time), ..living }
}

async fn names(store: &Store) -> Vec<String> {
    store.processes(None).await.unwrap().into_iter().map(|process| process.id).collect()
}

async fn lease(store: &Store, holder: &str, now: i64) -> Lease {
    store.lease(protocol("dft").hash, holder, now, 600).await.unwrap().unwrap()
}

/// Holders of the leases, in order.
async fn holders(store: &Store) -> Vec<String> {
    let leased = store.queue_list(Some(JobState::Leased), 100, 0).await.unwrap();
    let mut holders: Vec<_> = leased.into_iter().filter_map(|job| job.holder).collect();
    holders.sort();
    holders
}

#[tokio::test]
async fn a_record_is_read_as_it_was_written() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let mut record = living("l", ProcessRecord::LABELLER, Some(7));
    assert_eq!(Some(&record.start_time), process_start_time(std::process::id()).as_ref());
    record.restarts = 2;
    record.setup = Some("hash".into());
    record.remark = "killed by signal 9".into();
    store.upsert_process(&record).await.unwrap();
    assert_eq!(store.processes(Some("labeller")).await.unwrap(), [record.clone()]);
    assert_eq!(store.processes(Some("walker")).await.unwrap(), []);
    record.last_seen = 99;
    record.state = "stopping".into();
    store.upsert_process(&record).await.unwrap();
    assert_eq!(store.processes(None).await.unwrap(), [record.clone()]);
    assert_eq!(store.status().await.unwrap().processes, [record]);
}

#[tokio::test]
async fn a_process_replaces_its_dead_predecessor() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let walkers =
        [gone("w0", "walker", Some(0)), gone("w1", "walker", Some(1)), living("o", "orchestrator", None)];
    store.upsert_processes(&walkers).await.unwrap();
    store.upsert_process(&living("w1 again", "walker", Some(1))).await.unwrap();
    let mut found = names(&store).await;
    found.sort();
    assert_eq!(found, ["o", "w0", "w1 again"]);
    // A predecessor that is alive keeps its record.
    store.upsert_process(&living("w1 again again", "walker", Some(1))).await.unwrap();
    assert_eq!(names(&store).await.len(), 4);
    store.upsert_process(&living("l", "labeller", Some(1))).await.unwrap();
    store.remove_process("w0").await.unwrap();
    assert_eq!(names(&store).await.len(), 4);
    store.remove_process("o").await.unwrap();
    assert_eq!(names(&store).await, ["l"]);
}

#[tokio::test]
async fn leases_of_living_processes_last_and_those_of_dead_ones_are_released() {
    let database = TestDatabase::new();
    let store = database.create().await;
    accept(&store, 5).await;
    let processes = [
        living("living", "labeller", Some(0)),
        gone("gone", "labeller", Some(1)),
        living("leading", "orchestrator", None),
    ];
    store.upsert_processes(&processes).await.unwrap();
    for holder in ["living", "gone", "gone/3", "leading/0", "without record"] {
        lease(&store, holder, 0).await;
    }
    assert_eq!(store.release_leases_of_dead_processes(1).await.unwrap(), 3);
    assert_eq!(holders(&store).await, ["leading/0", "living"]);
    assert_eq!(store.release_leases_of_dead_processes(1).await.unwrap(), 0);
    let waiting = store.queue_list(Some(JobState::Queued), 9, 0).await.unwrap();
    assert!(waiting.len() == 3 && waiting.iter().all(|job| job.failures == 0));
    let attempts = store.queue_show(&waiting[0].candidate).await.unwrap().attempts_made;
    assert_eq!(attempts[0].outcome.as_deref(), Some("lost"));
}

#[tokio::test]
async fn an_expired_lease_continues_while_its_holder_may_be_at_work() {
    const HOUR: i64 = 3_600_000;
    let database = TestDatabase::new();
    let store = database.create().await;
    accept(&store, 6).await;
    let elsewhere = |id: &str, last_seen| {
        let here = living(id, "labeller", Some(7));
        let (place, ticks) = here.start_time.rsplit_once('/').unwrap();
        ProcessRecord { start_time: format!("{place}0/{ticks}"), last_seen, ..here }
    };
    let hangs = ProcessRecord { last_seen: -20 * HOUR, ..living("hangs", "labeller", Some(1)) };
    let processes = [
        living("asleep", "labeller", Some(0)),
        hangs,
        gone("gone", "labeller", Some(2)),
        elsewhere("heard elsewhere", 8 * HOUR - 599_000),
        elsewhere("silent elsewhere", 8 * HOUR - 600_000),
    ];
    store.upsert_processes(&processes).await.unwrap();
    for holder in ["asleep/3", "hangs", "gone", "heard elsewhere", "silent elsewhere"] {
        lease(&store, holder, 0).await;
    }
    let asleep = lease(&store, "asleep", 0).await;
    // The computer was suspended for eight hours.
    lease(&store, "first awake", 8 * HOUR).await;
    assert_eq!(holders(&store).await, ["asleep", "asleep/3", "first awake", "heard elsewhere"]);
    assert!(store.renew(&asleep, 8 * HOUR, 600).await.unwrap());
    let waiting = store.queue_list(Some(JobState::Queued), 9, 0).await.unwrap();
    assert!(waiting.len() == 2 && waiting.iter().all(|job| job.failures == 0));
}

#[tokio::test]
async fn a_starting_run_keeps_living_labellers_and_reclaims_other_leases() {
    let database = TestDatabase::new();
    let store = database.create().await;
    accept(&store, 5).await;
    let processes = [
        living("living", "labeller", Some(0)),
        gone("gone", "labeller", Some(1)),
        // The lock overrides the table.
        living("earlier", "orchestrator", None),
        living("w", "walker", Some(0)),
    ];
    store.upsert_processes(&processes).await.unwrap();
    let kept = lease(&store, "living", 0).await;
    for holder in ["gone", "earlier/0", "earlier/1", "without record"] {
        lease(&store, holder, 0).await;
    }
    assert_eq!(store.reclaim_leases(1).await.unwrap(), 4);
    assert_eq!((names(&store).await, holders(&store).await), (vec!["living".into()], vec!["living".into()]));
    assert!(store.renew(&kept, 2, 600).await.unwrap());
    let logged = store.operations(0, 100).await.unwrap().pop().unwrap();
    assert_eq!((logged.time, logged.kind.as_str()), (1, "lost"));
    assert_eq!(logged.detail, serde_json::json!({ "processes": ["earlier", "gone"], "leases": 4 }));
    // Nothing more to reclaim or to report.
    assert_eq!(store.reclaim_leases(2).await.unwrap(), 0);
    assert_eq!(store.operations(logged.number, 100).await.unwrap(), []);
}

#[tokio::test]
async fn status_shows_dead_and_failed_processes() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let said = |id: &str, number, state: &str| ProcessRecord {
        state: state.into(),
        ..gone(id, "walker", Some(number))
    };
    let processes = [
        said("a", 0, "running"),
        said("b", 1, "failed"),
        said("c", 2, "backing_off"),
        living("o", "orchestrator", None),
    ];
    store.upsert_processes(&processes).await.unwrap();
    let states = async || -> Vec<String> {
        store.status().await.unwrap().processes.into_iter().map(|process| process.state).collect()
    };
    assert_eq!(states().await, ["running", "dead", "failed", "backing_off"]);
    // Without its orchestrator the third is not restarted.
    store.upsert_process(&gone("o", "orchestrator", None)).await.unwrap();
    assert_eq!(states().await, ["dead", "dead", "failed", "dead"]);
}
