//! Reports that arrive together are decided one after the other, committed together, and answered afterwards.

use std::path::Path;
use std::time::Duration;

use orchestrator::reactor::{Reactor, ReactorError, RunOutcome, commit_batch};
use orchestrator::selector::{CampaignMode, Scheduling, Selector, SelectorSettings, UpdateProtocol};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use sqlx::ConnectOptions;
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use store::records::Commit;
use store::{CampaignRecord, Store, StoreError};
use tempfile::TempDir;
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;
use wire::messages::{AssignmentReport, Outcome, WalkEnd};
use wire::transport::{Incoming, WorkItem};

use crate::common::memory::MemoryStore;
use crate::common::*;

const WALKS: usize = 3;

fn live_settings() -> SelectorSettings {
    SelectorSettings { max_per_walk: 100, ..settings(CampaignMode::Live) }
}

/// What a walker may report on an assignment.
#[derive(Clone, Debug)]
enum Event {
    /// A structure with this number, whose second atom is at this distance along one direction.
    Candidate(u64, usize, f64),
    StepsDone,
    Paused,
    Ended,
}

fn event() -> impl Strategy<Value = Event> {
    prop_oneof![
        8 => (0..30_u64, 0..DIMENSION, 1.0..9.0).prop_map(|(number, k, far)| Event::Candidate(number, k, far)),
        2 => Just(Event::StepsDone),
        1 => Just(Event::Paused),
        1 => Just(Event::Ended),
    ]
}

fn any_settings() -> impl Strategy<Value = SelectorSettings> {
    let update = prop::sample::select(vec![UpdateProtocol::Cumulative, UpdateProtocol::PerSeedStructure]);
    (update, 1..5_u32, prop::option::of(1..9_u32), any::<bool>()).prop_map(
        |(update, max_per_walk, total, control)| SelectorSettings {
            update,
            max_per_walk,
            max_structures: total,
            control,
            ..live_settings()
        },
    )
}

/// The report on the next assignment for this event, if there is an assignment.
fn come(selector: &mut Selector, number: usize, event: &Event) -> Option<AssignmentReport> {
    let Scheduling::Assign(assignment) = selector.next_assignment(0) else { return None };
    let progress = at(10 * (number as u64 + 1));
    let outcome = match *event {
        Event::Candidate(structure_number, direction, far) => {
            let mut z = [0.0; DIMENSION];
            z[direction] = far;
            let structure = structure(structure_number, SHORTEST);
            Outcome::Candidate(block(&assignment, selector.mixture(), &progress, structure, z))
        }
        Event::StepsDone => Outcome::StepsDone,
        Event::Paused => Outcome::Interrupted,
        Event::Ended => Outcome::Ended(WalkEnd::Completed),
    };
    Some(report(&assignment, outcome, progress))
}

/// Commits of a live campaign, in order.
fn commits(settings: &SelectorSettings, events: &[Event]) -> Vec<Commit> {
    let mut selector = restore(settings, WALKS, Default::default());
    let mut commits = vec![selector.start_walks()];
    for (number, event) in events.iter().enumerate() {
        let Some(report) = come(&mut selector, number, event) else { break };
        commits.extend(selector.report(report).unwrap());
    }
    commits
}

proptest! {
    #![proptest_config(ProptestConfig { rng_seed: RngSeed::Fixed(11), ..ProptestConfig::default() })]

    #[test]
    fn a_batch_has_the_same_result_as_its_commits(
        settings in any_settings(),
        events in prop::collection::vec(event(), 1..40),
        cuts in prop::collection::vec(1..9_usize, 40),
    ) {
        let commits = commits(&settings, &events);
        let mut one_by_one = MemoryStore::default();
        commits.iter().for_each(|commit| one_by_one.commit(commit));
        let mut in_groups = MemoryStore::default();
        let (mut rest, mut cuts) = (commits.into_iter().peekable(), cuts.into_iter());
        while rest.peek().is_some() {
            let mut whole = Commit::default();
            rest.by_ref().take(cuts.next().unwrap_or(9)).for_each(|commit| commit_batch::append(&mut whole, commit));
            in_groups.commit(&whole);
        }
        prop_assert_eq!(in_groups, one_by_one);
    }

    /// The result does not depend on when a candidate is regraded, and under which mixture.
    #[test]
    fn candidates_may_be_regraded_ahead(
        settings in any_settings(),
        events in prop::collection::vec(event(), 1..40),
        ahead in prop::collection::vec(0..4_usize, 40),
    ) {
        let mut selectors = [(); 2].map(|()| begin(&settings, WALKS));
        let mut mixtures = vec![mixture()];
        for (number, (event, ahead)) in events.iter().zip(ahead).enumerate() {
            let [Some(report), Some(same)] = selectors.each_mut().map(|selector| come(selector, number, event)) else {
                break;
            };
            let [at_once, examined] = &mut selectors;
            let earlier = mixtures[mixtures.len().saturating_sub(1 + ahead)].clone();
            let examination = examined.regrader().regrade(same, &earlier);
            let commits = [at_once.report(report).unwrap(), examined.report_regraded(examination).unwrap()];
            prop_assert_eq!(format!("{:?}", commits[0]), format!("{:?}", commits[1]));
            mixtures.push(examined.mixture().clone());
        }
    }
}

/// A live campaign with a separate connection to its database.
struct Live {
    store: Store,
    selector: Selector,
    connection: SqliteConnection,
    _directory: TempDir,
}

/// Walkers whose reports are in the channel.
struct Arrived {
    to_reactor: mpsc::Sender<Incoming>,
    incoming: mpsc::Receiver<Incoming>,
    answers: Vec<oneshot::Receiver<Option<WorkItem>>>,
}

impl Live {
    async fn begin() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let store = create(directory.path()).await;
        let mut selector = restore(&live_settings(), WALKS, Default::default());
        store.commit(&selector.start_walks()).await.unwrap();
        let path = directory.path().join(store::DATABASE);
        let options = SqliteConnectOptions::new().filename(path).busy_timeout(Duration::from_secs(60));
        Self { store, selector, connection: options.connect().await.unwrap(), _directory: directory }
    }

    async fn execute(&mut self, sql: &'static str) {
        sqlx::query(sql).execute(&mut self.connection).await.unwrap();
    }

    /// A report of each walk, with a structure that is new to the mixture. The walker has the number of its walk.
    fn reports(&mut self) -> Vec<AssignmentReport> {
        let assignments: Vec<_> =
            (0..WALKS as u32).map(|walker| next_assignment_of(walker, &mut self.selector)).collect();
        let offer = |(k, assignment)| {
            let mut z = [0.0; DIMENSION];
            z[k] = 5.0;
            offer(&self.selector, assignment, 10, structure(k as u64, SHORTEST), z)
        };
        assignments.iter().enumerate().map(offer).collect()
    }

    /// The walks of the stored candidates, in decision order.
    async fn stored(&self) -> Vec<usize> {
        let candidates = self.store.candidates(0, true, 100).await.unwrap();
        candidates.iter().map(|candidate| candidate.block.view().id().walk.0 as usize).collect()
    }
}

async fn create(directory: &Path) -> Store {
    let campaign = CampaignRecord {
        id: CAMPAIGN,
        program_version: "0.1.0".into(),
        mode: "live".into(),
        configuration: String::new(),
        resolved_configuration: "{}".into(),
        configuration_in_force: "{}".into(),
    };
    let stored = |index| {
        let orchestrator::selector::SeedStructurePlan { name, structure, .. } =
            seed_structure(index as usize);
        store::SeedStructure { index, name, source: "seeds.extxyz".into(), structure }
    };
    let seeds: Vec<_> = (0..WALKS as u32).map(stored).collect();
    Store::create(directory, &campaign, &seeds, 0).await.unwrap()
}

impl Arrived {
    fn new(reports: Vec<AssignmentReport>) -> Self {
        let (to_reactor, incoming) = mpsc::channel(8);
        let send = |report: AssignmentReport| {
            let (reply, answer) = oneshot::channel();
            let walker = report.walk.0;
            to_reactor.try_send(Incoming::Idle { walker, report: Some(report), reply }).unwrap();
            answer
        };
        let answers = reports.into_iter().map(send).collect();
        Self { to_reactor, incoming, answers }
    }
}

fn reactor(store: &Store, selector: Selector, incoming: mpsc::Receiver<Incoming>) -> Reactor {
    let [stopping, walks_end] = [(); 2].map(|()| CancellationToken::new());
    Reactor {
        selector,
        store: store.clone(),
        incoming,
        stopping,
        walks_end,
        queue_limit: 100,
        completion: None,
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn answers_wait_for_the_commit_of_the_batch() {
    let mut live = Live::begin().await;
    let mut reports = live.reports();
    reports.swap(0, 2);
    let Arrived { to_reactor, incoming, mut answers } = Arrived::new(reports);
    let selector = std::mem::replace(&mut live.selector, begin(&live_settings(), WALKS));
    live.execute("BEGIN IMMEDIATE").await;
    let reactor = tokio::spawn(reactor(&live.store, selector, incoming).run(|_| ()));
    tokio::time::sleep(Duration::from_millis(300)).await;
    assert!(answers.iter_mut().all(|answer| answer.try_recv().is_err()), "answered before the commit");
    assert!(live.stored().await.is_empty());
    live.execute("ROLLBACK").await;
    for answer in answers {
        assert!(answer.await.unwrap().is_some());
    }
    assert_eq!(live.stored().await, [2, 1, 0], "in the order of arrival");
    drop(to_reactor);
    assert_eq!(reactor.await.unwrap().unwrap(), RunOutcome::Stopped);
}

/// The last report cannot be committed. Earlier ones may have been in the same batch or not.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_failed_batch_writes_nothing_and_is_not_answered() {
    let mut live = Live::begin().await;
    let first = live.reports().remove(2);
    let Outcome::Candidate(block) = first.outcome.clone() else { panic!("reports are of candidates") };
    let commit = live.selector.report(first).unwrap().unwrap();
    live.store.commit(&commit).await.unwrap();
    let before = live.store.decision_log_text().await.unwrap();
    (0..WALKS as u32 - 1).for_each(|walk| live.selector.assignment_lost(wire::WalkId(walk)));
    let mut reports = live.reports();
    // The candidate that is already stored, in a later assignment of its walk.
    reports[2].outcome = Outcome::Candidate(block);
    let Arrived { to_reactor: _open, incoming, mut answers } = Arrived::new(reports);
    let selector = std::mem::replace(&mut live.selector, begin(&live_settings(), WALKS));
    live.execute("BEGIN IMMEDIATE").await;
    let reactor = tokio::spawn(reactor(&live.store, selector, incoming).run(|_| ()));
    tokio::time::sleep(Duration::from_millis(300)).await;
    live.execute("ROLLBACK").await;
    let ended = reactor.await.unwrap();
    assert!(matches!(ended, Err(ReactorError::Store(StoreError::DuplicateCandidate(_)))), "{ended:?}");
    let mut stored = live.stored().await;
    assert_eq!(stored.remove(0), 2, "the one from before");
    let answered: Vec<_> =
        (0..WALKS).filter(|walk| matches!(answers[*walk].try_recv(), Ok(Some(_)))).collect();
    assert_eq!(answered, stored, "exactly the answered walks are stored");
    if stored.is_empty() {
        assert_eq!(live.store.decision_log_text().await.unwrap(), before);
    }
}
