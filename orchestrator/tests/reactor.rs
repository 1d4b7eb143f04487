//! The reactor with a real database and walkers on threads: nothing is lost, and nothing hangs.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;
use std::time::Duration;

use orchestrator::reactor::{Notice, Reactor, RunOutcome};
use orchestrator::selector::{CampaignMode, SelectorSettings, SelectorSnapshot};
use store::{CampaignRecord, JobState, Protocol, SeedStructure, Store};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use wire::messages::{AssignmentReport, WalkProgress};
use wire::transport::{InProcess, Incoming, Transport, WorkItem};
use wire::{ContentHash, WalkId};

use crate::common::scripted::{Event, Script, advance};
use crate::common::{CAMPAIGN, restore, seed_structure, settings};

const PROTOCOL: ContentHash = ContentHash([7; 32]);

/// Walks of 60 steps, each with a new structure every 7 steps and a rollback.
fn scripts() -> Vec<Script> {
    let event = |walk: u64, step: u64| match step {
        31 => Event::Return,
        step if step % 7 == 0 => {
            let mut z = [0.0; 3];
            z[(step / 7 % 3) as usize] = 1.6 * 1.3_f64.powi((step / 7) as i32);
            Event::Structure { number: 100 * walk + step, z, close: false }
        }
        _ => Event::Nothing,
    };
    (0..3).map(|walk| (1..=60).map(|step| event(walk, step)).collect()).collect()
}

#[tokio::test]
async fn a_stop_before_the_first_message_ends_the_reactor() {
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path()).await;
    let stopping = CancellationToken::new();
    // Transports from other hosts keep the channel open until the reactor has ended.
    let (reactor, _to_reactor) = reactor(&store, &stopping).await;
    let running = tokio::spawn(reactor.run(|_| {}));
    tokio::time::sleep(Duration::from_millis(50)).await;
    stopping.cancel();
    let ended = tokio::time::timeout(Duration::from_secs(60), running).await.expect("it ends");
    assert_eq!(ended.unwrap().unwrap(), RunOutcome::Stopped);
}

fn rounds() -> SelectorSettings {
    SelectorSettings { max_per_walk: 9, control: true, ..settings(CampaignMode::Reproducible) }
}

/// Opens or creates the campaign's database.
async fn open(directory: &Path) -> Store {
    if directory.join(store::DATABASE).exists() {
        return Store::open(directory).await.unwrap();
    }
    let campaign = CampaignRecord {
        id: CAMPAIGN,
        program_version: "0.1.0".into(),
        mode: "reproducible".into(),
        configuration: String::new(),
        resolved_configuration: "{}".into(),
        configuration_in_force: "{}".into(),
    };
    let seeds: Vec<_> = (0..3)
        .map(|index| SeedStructure {
            index,
            name: seed_structure(index as usize).name,
            source: "seeds.extxyz".into(),
            structure: seed_structure(index as usize).structure,
        })
        .collect();
    let store = Store::create(directory, &campaign, &seeds, 0).await.unwrap();
    let protocol = Protocol { hash: PROTOCOL, name: "reference".into(), settings: serde_json::json!({}) };
    store.add_protocol(&protocol, 0).await.unwrap();
    store
}

/// A reactor that continues from the database, and the channel to it.
async fn reactor(store: &Store, stopping: &CancellationToken) -> (Reactor, mpsc::Sender<Incoming>) {
    let snapshot = SelectorSnapshot {
        imported: 0,
        walks: store.load_walks().await.unwrap(),
        components: store.load_components().await.unwrap(),
        known: store.known_hashes().await.unwrap(),
        values: store.values().await.unwrap(),
    };
    let mut selector = restore(&rounds(), 3, snapshot);
    let begun = selector.start_walks();
    if !begun.walks.is_empty() {
        store.commit(&begun).await.unwrap();
    }
    let (to_reactor, incoming) = mpsc::channel(2);
    let (store, stopping, queue_limit) = (store.clone(), stopping.clone(), 1000);
    let walks_end = CancellationToken::new();
    (Reactor { selector, store, incoming, stopping, walks_end, queue_limit, completion: None }, to_reactor)
}

/// Works on an assignment like a scripted walker: interrupted after a few steps if asked to stop.
fn work_on(work: &WorkItem, transport: &InProcess) -> AssignmentReport {
    let assignment = &work.assignment;
    let seed = (0..3).find(|number| seed_structure(*number).structure == assignment.seed_structure).unwrap();
    let pause = transport.stopping().then_some(2);
    let report = advance(&scripts()[seed], assignment, &work.mixture, pause);
    transport.progress(report.walk, report.progress.clone());
    report
}

/// Walkers on threads; dropping the sender afterwards ends the reactor.
fn start_walkers(
    number: u32,
    to_reactor: mpsc::Sender<Incoming>,
    stopping: &CancellationToken,
) -> Vec<thread::JoinHandle<()>> {
    let start = |walker| {
        let mut transport = InProcess::new(walker, to_reactor.clone(), stopping.clone());
        thread::spawn(move || {
            let mut report = None;
            while let Some(work) = transport.exchange(report.take()) {
                report = Some(work_on(&work, &transport).map_candidate(|block| block.view().to_candidate()));
            }
        })
    };
    (0..number).map(start).collect()
}

/// How a reactor ends; its walkers are released even if it hangs.
async fn end_of(reactor: Reactor, watch: impl FnMut(Notice<'_>)) -> RunOutcome {
    let ended = tokio::time::timeout(Duration::from_secs(120), reactor.run(watch)).await;
    ended.expect("the reactor hangs").unwrap()
}

/// Runs until it ends, or until `stop_after` commits.
async fn run(store: &Store, walkers: u32, stop_after: usize) -> RunOutcome {
    let stopping = CancellationToken::new();
    let (reactor, to_reactor) = reactor(store, &stopping).await;
    let threads = start_walkers(walkers, to_reactor, &stopping);
    let mut commits = 0;
    let watch = |notice: Notice<'_>| {
        commits += usize::from(matches!(notice, Notice::Committed(_)));
        if commits >= stop_after {
            stopping.cancel();
        }
    };
    let ended = end_of(reactor, watch).await;
    threads.into_iter().for_each(|thread| thread.join().unwrap());
    ended
}

/// Everything in a database that must be equal in two runs of a campaign.
async fn content(store: &Store) -> (String, String) {
    let rest = (
        store.candidates(0, true, 1000).await.unwrap(),
        store.load_walks().await.unwrap(),
        store.load_components().await.unwrap(),
        store.values().await.unwrap(),
    );
    (store.decision_log_text().await.unwrap(), format!("{rest:?}"))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_is_lost_when_a_campaign_is_stopped_again_and_again() {
    let folders = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let whole = open(folders[0].path()).await;
    assert_eq!(run(&whole, 1, usize::MAX).await, RunOutcome::Finished);
    let (log, rest) = content(&whole).await;
    let log_has = |kind: &str| log.contains(kind);
    assert!(["accepted", "declined", "control", "segment", "ended"].into_iter().all(log_has), "{log}");

    let mut times = 0;
    let stopped = loop {
        let store = open(folders[1].path()).await;
        if run(&store, 3, 1 + times % 3).await == RunOutcome::Finished {
            break store;
        }
        store.close().await;
        times += 1;
        assert!(times < 500, "the campaign does not advance");
    };
    assert!(times > 5);
    let (log_of_stopped, rest_of_stopped) = content(&stopped).await;
    assert_eq!(log_of_stopped, log);
    assert_eq!(rest_of_stopped, rest);
    assert_eq!(run(&stopped, 2, usize::MAX).await, RunOutcome::Finished, "a campaign that is over stays so");
    assert_eq!(content(&stopped).await.0, log);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn walkers_wait_while_the_label_queue_is_full() {
    const LIMIT: u64 = 2;
    let folder = tempfile::tempdir().unwrap();
    let store = open(folder.path()).await;
    let stopping = CancellationToken::new();
    let (reactor, to_reactor) = reactor(&store, &stopping).await;
    let reactor = Reactor { queue_limit: LIMIT, ..reactor };
    let threads = start_walkers(2, to_reactor, &stopping);
    let (full, mut seen_full) = mpsc::unbounded_channel();
    let commits = Arc::new(AtomicUsize::new(0));
    let count = Arc::clone(&commits);
    let running = tokio::spawn(end_of(reactor, move |notice| match notice {
        Notice::QueueFull(unfinished) => full.send(unfinished).unwrap(),
        Notice::Committed(_) => drop(count.fetch_add(1, Ordering::Relaxed)),
        Notice::Progress(..) | Notice::Walkers { .. } => {}
    }));
    let mut times = 0;
    while let Some(unfinished) = seen_full.recv().await {
        assert!((LIMIT + 1..=LIMIT + 4).contains(&unfinished), "{unfinished}: the limit and at most a round");
        if store.unfinished_jobs().await.unwrap() <= LIMIT {
            continue; // It was full before the jobs below were taken out.
        }
        // While the queue is full, only the current round may still be committed.
        let before = commits.load(Ordering::Relaxed);
        tokio::time::sleep(Duration::from_millis(450)).await;
        assert!(commits.load(Ordering::Relaxed) <= before + 1);
        for job in store.queue_list(Some(JobState::Queued), 10, 0).await.unwrap() {
            store.drop_job(&job.candidate, 0).await.unwrap();
        }
        times += 1;
    }
    assert!(times > 2);
    assert_eq!(running.await.unwrap(), RunOutcome::Finished);
    threads.into_iter().for_each(|thread| thread.join().unwrap());
}

/// With a raised threshold, the queue may grow to twice the limit, but no further.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn walkers_continue_with_a_raised_threshold_up_to_twice_the_limit() {
    const LIMIT: u64 = 2;
    let folder = tempfile::tempdir().unwrap();
    let store = open(folder.path()).await;
    let stopping = CancellationToken::new();
    let (mut reactor, to_reactor) = reactor(&store, &stopping).await;
    reactor.selector.raise_threshold_above(LIMIT);
    let reactor = Reactor { queue_limit: LIMIT, ..reactor };
    let (full, mut seen_full) = mpsc::unbounded_channel();
    let running = tokio::spawn(end_of(reactor, move |notice| {
        if let Notice::QueueFull(unfinished) = notice {
            full.send(unfinished).unwrap();
        }
    }));
    // Simulated walkers record the threshold factor of each assignment.
    let raised = Arc::new(std::sync::Mutex::new(Vec::new()));
    let (seen, mut transport) = (Arc::clone(&raised), InProcess::new(0, to_reactor, stopping.clone()));
    let walker = thread::spawn(move || {
        let mut report = None;
        while let Some(work) = transport.exchange(report.take()) {
            seen.lock().unwrap().push(work.assignment.threshold_factor);
            report = Some(work_on(&work, &transport).map_candidate(|block| block.view().to_candidate()));
        }
    });
    let mut times = 0;
    while let Some(unfinished) = seen_full.recv().await {
        assert!((2 * LIMIT + 1..=2 * LIMIT + 4).contains(&unfinished), "{unfinished}");
        for job in store.queue_list(Some(JobState::Queued), 10, 0).await.unwrap() {
            store.drop_job(&job.candidate, 0).await.unwrap();
        }
        times += 1;
    }
    assert_eq!(running.await.unwrap(), RunOutcome::Finished);
    walker.join().unwrap();
    let raised = raised.lock().unwrap().clone();
    assert!(times > 0 && raised.contains(&1.0), "{raised:?}");
    assert!(
        raised.iter().any(|factor| *factor > 1.0) && raised.iter().all(|factor| *factor <= 2.0),
        "{raised:?}"
    );
    let decisions = store.decisions(1..=i64::MAX).await.unwrap();
    let factors: Vec<_> =
        decisions.iter().filter_map(|decision| decision.detail["raised_by"].as_f64()).collect();
    assert!(!factors.is_empty() && factors.iter().all(|factor| (1.0..=2.0).contains(factor)), "{factors:?}");
}

/// A campaign whose only walker waits can be stopped, even while progress is reported continuously.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn waiting_walkers_are_shut_down_when_the_campaign_stops() {
    let folder = tempfile::tempdir().unwrap();
    let store = open(folder.path()).await;
    let stopping = CancellationToken::new();
    let (reactor, to_reactor) = reactor(&store, &stopping).await;
    let reactor = Reactor { queue_limit: 0, ..reactor };
    let talker = InProcess::new(9, to_reactor.clone(), stopping.clone());
    let walker = start_walkers(1, to_reactor, &stopping).remove(0);
    let talking = thread::spawn(move || {
        while !walker.is_finished() {
            talker.progress(WalkId(0), WalkProgress::default());
            thread::sleep(Duration::from_millis(2));
        }
    });
    let watch = move |notice: Notice<'_>| {
        if matches!(notice, Notice::QueueFull(_)) {
            stopping.cancel();
        }
    };
    assert_eq!(end_of(reactor, watch).await, RunOutcome::Stopped);
    talking.join().unwrap();
}

/// The assignment of a lost walker goes to another one.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn assignments_of_dead_walkers_are_completed_by_others() {
    let folder = tempfile::tempdir().unwrap();
    let store = open(folder.path()).await;
    let stopping = CancellationToken::new();
    let (reactor, to_reactor) = reactor(&store, &stopping).await;
    let mut mortal = InProcess::new(9, to_reactor.clone(), stopping.clone());
    let dying = thread::spawn(move || {
        let work = mortal.exchange(None).expect("the first idle walker gets an assignment");
        drop(work);
    });
    let running = tokio::spawn(end_of(reactor, |_| ()));
    tokio::task::spawn_blocking(|| dying.join().unwrap()).await.unwrap();
    let threads = start_walkers(2, to_reactor, &stopping);
    assert_eq!(running.await.unwrap(), RunOutcome::Finished);
    threads.into_iter().for_each(|thread| thread.join().unwrap());
}

/// A walker that asks again without a report no longer holds its walk.
#[tokio::test(flavor = "multi_thread")]
async fn walks_without_a_report_are_assigned_again() {
    let folder = tempfile::tempdir().unwrap();
    let store = open(folder.path()).await;
    let stopping = CancellationToken::new();
    let (reactor, to_reactor) = reactor(&store, &stopping).await;
    let running = tokio::spawn(end_of(reactor, |_| {}));
    for _ in 0..2 {
        let (reply, answer) = tokio::sync::oneshot::channel();
        to_reactor.send(Incoming::Idle { walker: 9, report: None, reply }).await.unwrap();
        assert_eq!(answer.await.unwrap().expect("an assignment").assignment.walk, WalkId(0));
    }
    to_reactor.send(Incoming::Lost { walker: 9, crashed: false }).await.unwrap();
    let threads = start_walkers(2, to_reactor, &stopping);
    assert_eq!(running.await.unwrap(), RunOutcome::Finished);
    threads.into_iter().for_each(|thread| thread.join().unwrap());
}

#[tokio::test]
async fn a_campaign_without_walkers_is_not_finished() {
    let folder = tempfile::tempdir().unwrap();
    let store = open(folder.path()).await;
    let (reactor, to_reactor) = reactor(&store, &CancellationToken::new()).await;
    drop(to_reactor);
    assert_eq!(end_of(reactor, |_| ()).await, RunOutcome::Stopped);
}

/// Walkers that exit during the first assignment of the first walk: by repeated crashes, or because they are killed.
#[tokio::test(flavor = "multi_thread")]
async fn assignments_that_crash_walkers_end_their_walk() {
    for (fault, walkers) in [(true, 3), (false, 5)] {
        let directory = tempfile::tempdir().unwrap();
        let store = open(directory.path()).await;
        let stopping = CancellationToken::new();
        let (reactor, to_reactor) = reactor(&store, &stopping).await;
        let running = tokio::spawn(end_of(reactor, |_| {}));
        for walker in 0..walkers {
            let (reply, answer) = tokio::sync::oneshot::channel();
            to_reactor.send(Incoming::Idle { walker, report: None, reply }).await.unwrap();
            assert_eq!(answer.await.unwrap().expect("an assignment").assignment.walk, WalkId(0));
            to_reactor.send(Incoming::Lost { walker, crashed: fault }).await.unwrap();
        }
        let threads = start_walkers(1, to_reactor, &stopping);
        assert_eq!(running.await.unwrap(), RunOutcome::Finished);
        threads.into_iter().for_each(|thread| thread.join().unwrap());
        let walk = store.load_walks().await.unwrap().remove(0);
        let expected = "3 walkers crashed in this assignment";
        assert_eq!((walk.state == "diverged", walk.reason == expected), (fault, fault));
        let log = store.decision_log_text().await.unwrap();
        assert_eq!(log.contains(expected), fault, "{log}");
    }
}

/// A paused walk gets no assignment, its round waits for it, and the decisions are the same as without a pause.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pausing_a_walk_does_not_change_decisions() {
    let folders = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let whole = open(folders[0].path()).await;
    assert_eq!(run(&whole, 2, usize::MAX).await, RunOutcome::Finished);

    let store = open(folders[1].path()).await;
    let stopping = CancellationToken::new();
    let (reactor, to_reactor) = reactor(&store, &stopping).await;
    let threads = start_walkers(2, to_reactor, &stopping);
    store.pause_walks(&[WalkId(1)], true, 0).await.unwrap();
    let running = tokio::spawn(end_of(reactor, |_| {}));
    let assignments = async || {
        let walks = store.load_walks().await.unwrap();
        walks.iter().map(|walk| walk.assignments).collect::<Vec<_>>()
    };
    tokio::time::sleep(Duration::from_millis(700)).await;
    assert_eq!((assignments().await, running.is_finished()), (vec![0; 3], false), "the first round waits");
    store.pause_walks(&[WalkId(1)], false, 0).await.unwrap();
    assert_eq!(running.await.unwrap(), RunOutcome::Finished);
    threads.into_iter().for_each(|thread| thread.join().unwrap());
    assert_eq!(content(&store).await, content(&whole).await);
}
