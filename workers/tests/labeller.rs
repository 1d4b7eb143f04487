//! Labellers: leases that last as long as a label takes, and processes that outlive their orchestrator.

use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use atoms::{Evaluation, NeighbourList, Potential, PotentialError, Species, Structure};
use sqlx::ConnectOptions;
use sqlx::sqlite::SqliteConnectOptions;
use store::{
    DATABASE, JobState, LabelRecord, LabelStatus, ProcessRecord, Store, StoreError, this_host,
    unix_milliseconds,
};
use tokio::task::JoinHandle;
use workers::labeller::{ExitPolicy, LabelBounds, LabellerSettings, Method, Shutdown, Timing, run, serve};

use crate::common::*;

/// A method that starts labels at once and finishes them only while it is open.
#[derive(Clone, Default)]
struct Gate {
    open: Arc<AtomicBool>,
    begun: Arc<AtomicUsize>,
}

impl Gate {
    fn opened() -> Self {
        let gate = Self::default();
        gate.open.store(true, Ordering::Relaxed);
        gate
    }

    fn method(&self) -> Method {
        Method::reference(Box::new(self.clone()))
    }

    async fn wait_for_labels(&self, begun: usize) {
        until("no label is begun", async || self.begun.load(Ordering::Relaxed) >= begun).await;
    }
}

/// A label that never ends must not block the runtime.
impl Drop for Gate {
    fn drop(&mut self) {
        self.open.store(true, Ordering::Relaxed);
    }
}

impl Potential for Gate {
    fn cutoff(&self) -> f64 {
        1.0
    }

    fn species(&self) -> &[Species] {
        &[]
    }

    fn evaluate(
        &mut self,
        structure: &Structure,
        _: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        self.begun.fetch_add(1, Ordering::Relaxed);
        while !self.open.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(1));
        }
        out.reset(structure.len());
        Ok(())
    }
}

/// A method with given energies, eV/atom, one per label.
struct Energies(std::vec::IntoIter<f64>);

impl Potential for Energies {
    fn cutoff(&self) -> f64 {
        1.0
    }

    fn species(&self) -> &[Species] {
        &[]
    }

    fn evaluate(
        &mut self,
        structure: &Structure,
        _: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        out.reset(structure.len());
        out.atomic_energies.fill(self.0.next().expect("as many energies as labels"));
        Ok(())
    }
}

/// Labels the first structures of a campaign with these energies, eV/atom, one attempt each. Returns, in that
/// order, the energies of valid labels, and class and log of the others.
async fn labelled_with(energies: &[f64]) -> Vec<Result<f64, (String, String)>> {
    let directory = tempfile::tempdir().unwrap();
    let store = create(directory.path()).await;
    let candidates = accept(&store, energies.len() as u64).await;
    let shutdown = Shutdown::default();
    shutdown.set_no_more_jobs(true);
    let method = Method::reference(Box::new(Energies(Vec::from(energies).into_iter())));
    let settings = LabellerSettings { attempts: 1, ..settings("a/0") };
    run(store.clone(), method, settings, &shutdown, unix_milliseconds, |_| ()).await.unwrap();
    let mut outcomes = Vec::new();
    for candidate in candidates {
        let mut details = store.queue_show(&candidate).await.unwrap();
        outcomes.push(match (details.energies.first(), details.attempts_made.remove(0)) {
            (Some((_, energy)), _) => Ok(energy / ATOMS as f64),
            (None, attempt) => Err((attempt.class.unwrap(), attempt.log.unwrap())),
        });
    }
    outcomes
}

async fn until(or: &str, condition: impl AsyncFn() -> bool) {
    let started = Instant::now();
    while !condition().await {
        assert!(started.elapsed() < Duration::from_secs(60), "{or}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

fn settings(holder: &str) -> LabellerSettings {
    LabellerSettings {
        holder: holder.into(),
        protocol: protocol("dft"),
        attempts: 3,
        bounds: LabelBounds::default(),
        exit_policy: ExitPolicy::UntilEmpty,
        timing: Timing {
            lease: Duration::from_secs(1),
            idle: Duration::from_millis(5),
            heartbeat_interval: Duration::from_millis(20),
            grace: None,
        },
    }
}

/// A living process (this one).
fn living(id: &str, kind: &str, number: Option<u32>) -> ProcessRecord {
    let process = ProcessRecord::new(kind, number, std::process::id(), unix_milliseconds());
    ProcessRecord { id: id.into(), ..process }
}

/// Its process id belongs to another process now.
fn gone(id: &str, kind: &str, number: Option<u32>) -> ProcessRecord {
    let living = living(id, kind, number);
    ProcessRecord { start_time: format!("{}0", living.start_time), ..living }
}

struct Labeller {
    shutdown: Arc<Shutdown>,
    task: JoinHandle<Result<(), StoreError>>,
}

impl Labeller {
    /// A labeller "l" with number 0 and its own connections, as in a process.
    async fn serving(directory: &Path, gate: &Gate) -> Self {
        Self::with(directory, gate, settings("l")).await
    }

    async fn with(directory: &Path, gate: &Gate, settings: LabellerSettings) -> Self {
        let store = Store::open(directory).await.unwrap();
        let (method, shutdown) = (gate.method(), Arc::new(Shutdown::default()));
        let (process, asked) = (living("l", ProcessRecord::LABELLER, Some(0)), Arc::clone(&shutdown));
        let task =
            async move { serve(store, method, settings, process, &asked, unix_milliseconds, |_| ()).await };
        Self { shutdown, task: tokio::spawn(task) }
    }

    async fn ended(self) -> Result<(), StoreError> {
        let ended = tokio::time::timeout(Duration::from_secs(60), self.task).await;
        ended.expect("the labeller does not exit").unwrap()
    }
}

async fn number(store: &Store, state: JobState) -> usize {
    store.queue_list(Some(state), 100, 0).await.unwrap().len()
}

async fn names(store: &Store) -> Vec<String> {
    store.processes(None).await.unwrap().into_iter().map(|process| process.id).collect()
}

async fn history(store: &Store) -> Vec<LabelRecord> {
    let structure = store.known_hashes().await.unwrap()[0];
    store.labels_of(structure).await.unwrap().into_iter().map(|label| label.record).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lease_lasts_as_long_as_the_label_takes() {
    let directory = tempfile::tempdir().unwrap();
    let store = create(directory.path()).await;
    let candidates = accept(&store, 1).await;
    let gate = Gate::default();
    let shutdown = Shutdown::default();
    shutdown.set_no_more_jobs(true);
    let (method, own, mut settings) = (gate.method(), store.clone(), settings("a/0"));
    settings.timing.lease = Duration::from_secs(10);
    let labeller =
        tokio::spawn(async move { run(own, method, settings, &shutdown, unix_milliseconds, |_| ()).await });
    gate.wait_for_labels(1).await;
    let started = Instant::now();
    while started.elapsed() < Duration::from_secs(15) {
        let now = unix_milliseconds();
        assert!(store.lease(protocol("dft").hash, "b", now, 1).await.unwrap().is_none());
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    gate.open.store(true, Ordering::Relaxed);
    labeller.await.unwrap().unwrap();
    let job = store.queue_show(&candidates[0]).await.unwrap();
    assert_eq!((job.job.state, job.job.attempts), (JobState::Labelled, 1));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn energies_out_of_bounds_fail_from_the_first_label_on() {
    let outcomes = labelled_with(&[1e300, -106.0, f64::INFINITY]).await;
    let (class, log) = outcomes[0].as_ref().unwrap_err();
    assert_eq!(class, "implausible");
    assert!(
        log.contains("an energy of 1.000e300 eV/atom, beyond label.max_energy_per_atom = 2000000 eV/atom"),
        "{log}"
    );
    assert_eq!(outcomes[1], Ok(-106.0));
    let (class, log) = outcomes[2].as_ref().unwrap_err();
    assert_eq!(class, "implausible");
    assert!(log.contains("an energy of inf, which is not a finite number"), "{log}");
}

/// The second is accepted, since nothing is known at that point, and does no harm.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn energies_are_compared_with_the_potential_once_offsets_are_known() {
    let energies = [-106.0, 1e6, -106.1, -105.9, -106.0, -105.0, 1e4, -107.0, -206.5, -204.0];
    let outcomes = labelled_with(&energies).await;
    let believed: Vec<_> = outcomes.iter().filter_map(|outcome| outcome.clone().ok()).collect();
    assert_eq!(believed, [-106.0, 1e6, -106.1, -105.9, -106.0, -105.0, -107.0, -204.0]);
    let (class, log) = outcomes[6].as_ref().unwrap_err();
    assert_eq!(class, "implausible");
    assert!(log.contains("differs by 10105.8 eV/atom") && log.contains("from 5 labels"), "{log}");
    let (_, log) = outcomes[8].as_ref().unwrap_err();
    assert!(log.contains("beyond label.max_energy_difference_per_atom = 100 eV/atom"), "{log}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_result_whose_lease_was_lost_becomes_a_check() {
    let directory = tempfile::tempdir().unwrap();
    let store = create(directory.path()).await;
    accept(&store, 1).await;
    let gate = Gate::default();
    let labeller = Labeller::serving(directory.path(), &gate).await;
    gate.wait_for_labels(1).await;
    let now = unix_milliseconds();
    store.release_all("l", now).await.unwrap();
    let other = store.lease(protocol("dft").hash, "other", now, 600).await.unwrap().unwrap();
    store.complete(&other, &label(-1.0), now).await.unwrap();
    // It has noticed by now.
    tokio::time::sleep(Duration::from_millis(500)).await;
    gate.open.store(true, Ordering::Relaxed);
    labeller.ended().await.unwrap();
    let history = history(&store).await;
    let found: Vec<_> = history.iter().map(|record| (record.status, record.label.energy)).collect();
    assert_eq!(found, [(LabelStatus::Label, -1.0), (LabelStatus::Check, 0.0)]);
}

/// The database is blocked for longer than a connection waits, and the labeller is asked to stop in that time.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_label_is_not_lost_while_the_database_is_locked() {
    let directory = tempfile::tempdir().unwrap();
    let store = create(directory.path()).await;
    accept(&store, 1).await;
    let gate = Gate::default();
    let labeller = Labeller::serving(directory.path(), &gate).await;
    gate.wait_for_labels(1).await;
    let other = SqliteConnectOptions::new().filename(directory.path().join(DATABASE));
    let mut other = other.connect().await.unwrap();
    sqlx::query("BEGIN IMMEDIATE").execute(&mut other).await.unwrap();
    gate.open.store(true, Ordering::Relaxed);
    labeller.shutdown.stop.cancel();
    tokio::time::sleep(Duration::from_secs(35)).await;
    assert!(!labeller.task.is_finished());
    assert_eq!(number(&store, JobState::Labelled).await, 0);
    sqlx::query("ROLLBACK").execute(&mut other).await.unwrap();
    labeller.ended().await.unwrap();
    assert_eq!((number(&store, JobState::Labelled).await, names(&store).await), (1, vec![]));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_labeller_stays_while_an_orchestrator_lives_and_exits_after_it() {
    let directory = tempfile::tempdir().unwrap();
    let store = create(directory.path()).await;
    store.upsert_process(&living("o", ProcessRecord::ORCHESTRATOR, None)).await.unwrap();
    let labeller = Labeller::serving(directory.path(), &Gate::opened()).await;
    accept(&store, 2).await;
    until("no label comes", async || number(&store, JobState::Labelled).await == 2).await;
    let seen = async || store.processes(Some("labeller")).await.unwrap()[0].last_seen;
    let first = seen().await;
    until("no sign of life comes", async || seen().await > first).await;
    assert!(!labeller.task.is_finished());
    store.upsert_process(&gone("o", ProcessRecord::ORCHESTRATOR, None)).await.unwrap();
    labeller.ended().await.unwrap();
    assert_eq!(names(&store).await, ["o"]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn without_an_orchestrator_the_queue_is_emptied_before_exit() {
    let directory = tempfile::tempdir().unwrap();
    let store = create(directory.path()).await;
    accept(&store, 4).await;
    let lost = [gone("o", ProcessRecord::ORCHESTRATOR, None), gone("dead", ProcessRecord::LABELLER, Some(1))];
    store.upsert_processes(&lost).await.unwrap();
    // Longer than this test: they are released because their holders are dead.
    for holder in ["dead", "o/0"] {
        let now = unix_milliseconds();
        store.lease(protocol("dft").hash, holder, now, 86_400).await.unwrap().unwrap();
    }
    Labeller::serving(directory.path(), &Gate::opened()).await.ended().await.unwrap();
    let jobs = store.queue_list(None, 10, 0).await.unwrap();
    assert!(jobs.iter().all(|job| (job.state, job.failures) == (JobState::Labelled, 0)), "{jobs:?}");
    assert!(!names(&store).await.contains(&"l".to_owned()));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_waits_for_the_current_label_while_heartbeats_continue() {
    let directory = tempfile::tempdir().unwrap();
    let store = create(directory.path()).await;
    accept(&store, 2).await;
    let gate = Gate::default();
    let labeller = Labeller::serving(directory.path(), &gate).await;
    gate.wait_for_labels(1).await;
    labeller.shutdown.stop.cancel();
    let own = async || store.processes(Some("labeller")).await.unwrap().remove(0);
    until("its record says that it stops", async || own().await.state == "stopping").await;
    let first = own().await.last_seen;
    until("no sign of life comes", async || own().await.last_seen > first).await;
    assert!(!labeller.task.is_finished());
    gate.open.store(true, Ordering::Relaxed);
    labeller.ended().await.unwrap();
    let numbers = (number(&store, JobState::Labelled).await, number(&store, JobState::Queued).await);
    assert_eq!((numbers, names(&store).await), ((1, 1), vec![]));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_label_that_outlasts_the_grace_period_is_released() {
    let directory = tempfile::tempdir().unwrap();
    let store = create(directory.path()).await;
    let candidates = accept(&store, 1).await;
    let gate = Gate::default();
    let mut settings = settings("l");
    settings.timing.grace = Some(Duration::from_millis(300));
    let labeller = Labeller::with(directory.path(), &gate, settings).await;
    gate.wait_for_labels(1).await;
    let started = Instant::now();
    labeller.shutdown.stop.cancel();
    labeller.ended().await.unwrap();
    assert!(started.elapsed() >= Duration::from_millis(300));
    assert_eq!((number(&store, JobState::Queued).await, names(&store).await), (1, vec![]));
    let job = store.queue_show(&candidates[0]).await.unwrap();
    assert_eq!((job.job.failures, job.attempts_made[0].outcome.as_deref()), (0, Some("released")));
}

/// Also without an orchestrator, until every walk is over.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_labeller_may_wait_for_the_end_of_the_campaign() {
    let directory = tempfile::tempdir().unwrap();
    let store = create(directory.path()).await;
    let (gate, settings) =
        (Gate::opened(), LabellerSettings { exit_policy: ExitPolicy::UntilFinished, ..settings("l") });
    let labeller = Labeller::with(directory.path(), &gate, settings).await;
    for (labelled, walks) in [(2, vec![]), (4, vec![walk(0, 1)])] {
        store.commit(&store::Commit { walks, ..store::Commit::default() }).await.unwrap();
        accept_from(&store, labelled - 1, 2).await;
        until("no label comes", async || number(&store, JobState::Labelled).await as u64 == labelled).await;
        tokio::time::sleep(Duration::from_millis(300)).await;
        assert!(!labeller.task.is_finished());
    }
    let over = store::WalkRecord { state: "completed".into(), ..walk(0, 2) };
    store.commit(&store::Commit { walks: vec![over], ..store::Commit::default() }).await.unwrap();
    labeller.ended().await.unwrap();
    assert_eq!((number(&store, JobState::Labelled).await, names(&store).await), (4, vec![]));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_two_labellers_with_one_number_the_earlier_exits() {
    let directory = tempfile::tempdir().unwrap();
    let store = create(directory.path()).await;
    store.upsert_process(&living("o", ProcessRecord::ORCHESTRATOR, None)).await.unwrap();
    let labeller = Labeller::serving(directory.path(), &Gate::opened()).await;
    until("it is not known", async || names(&store).await.contains(&"l".to_owned())).await;
    let newer = living("newer", ProcessRecord::LABELLER, Some(0));
    let newer = ProcessRecord { started: newer.started + 1000, ..newer };
    store.upsert_process(&ProcessRecord { number: Some(1), ..newer.clone() }).await.unwrap();
    tokio::time::sleep(Duration::from_millis(200)).await;
    assert!(!labeller.task.is_finished(), "another number");
    store.upsert_process(&newer).await.unwrap();
    labeller.ended().await.unwrap();
    assert_eq!(names(&store).await, ["o", "newer"]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_labeller_ends_when_its_campaign_was_deleted() {
    for at_work in [false, true] {
        let directory = tempfile::tempdir().unwrap();
        let store = create(directory.path()).await;
        store.upsert_process(&living("o", ProcessRecord::ORCHESTRATOR, None)).await.unwrap();
        let gate = Gate::default();
        let labeller = Labeller::serving(directory.path(), &gate).await;
        if at_work {
            accept(&store, 1).await;
            gate.wait_for_labels(1).await;
        }
        until("it is not known", async || names(&store).await.contains(&"l".to_owned())).await;
        fs::remove_dir_all(directory.path()).unwrap();
        // Another campaign in the same directory is not its own.
        fs::create_dir(directory.path()).unwrap();
        let other = create(directory.path()).await;
        let error = labeller.ended().await.unwrap_err();
        assert!(matches!(error, StoreError::Removed { .. }), "{error}");
        assert_eq!(names(&other).await, Vec::<String>::new());
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_error_that_ends_a_labeller_is_recorded() {
    let directory = tempfile::tempdir().unwrap();
    let store = create(directory.path()).await;
    accept(&store, 1).await;
    let wrong = LabellerSettings { protocol: protocol("unknown"), ..settings("l") };
    let labeller = Labeller::with(directory.path(), &Gate::opened(), wrong).await;
    let error = labeller.ended().await.unwrap_err();
    assert!(matches!(error, StoreError::UnknownProtocol(_)), "{error}");
    let own = store.processes(Some("labeller")).await.unwrap().remove(0);
    assert_eq!((own.state.as_str(), own.host), ("failed", this_host()));
    assert!(own.remark.contains("no label protocol"), "{}", own.remark);
}
