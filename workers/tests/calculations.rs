//! Calculations by another program, here a shell script: kept, found again, ended, put away.

#[path = "../../store/tests/common/mod.rs"]
mod common;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use atoms::{Species, Structure};
use common::*;
use dft::{Calculated, Code, Exit, Failure, FailureClass, Input, Original, Remedy, SetupError, Size};
use serde_json::json;
use store::{
    Attempt, JobDetails, JobState, LabelRecord, ProcessRecord, Standing, Store, StoreError, unix_milliseconds,
};
use tempfile::TempDir;
use tokio::task::JoinHandle;
use workers::labeller::{
    Closing, Keep, KeeperCommand, LabellerSettings, Method, Running, Stay, Timing, keep, label_once, serve,
};

/// Not a test: what the others start as the keepers of their calculations.
#[test]
#[ignore = "keeps the calculations of the other tests"]
fn keeper() {
    keep().unwrap();
}

fn keeper_command() -> KeeperCommand {
    let arguments = ["keeper", "--exact", "--ignored", "--nocapture"].map(str::to_owned).to_vec();
    KeeperCommand { program: std::env::current_exe().unwrap(), arguments }
}

/// A shell script: exit code 0 is a label whose energy stands in `energy`, 3 says not converged.
struct Script {
    text: String,
    /// A file of which it gets a copy.
    setup: Option<Original>,
}

impl Code for Script {
    fn identity(&self) -> serde_json::Value {
        json!(self.text)
    }

    fn supports(&self, _: &BTreeSet<Species>) -> Result<(), SetupError> {
        Ok(())
    }

    fn input(&self, _: &Structure, remedies: &BTreeSet<Remedy>) -> Result<Input, Failure> {
        let names: Vec<_> = remedies.iter().map(|remedy| remedy.name()).collect();
        let files = [("job.sh", self.text.clone()), ("remedies", format!("first\n{}\n", names.join(" ")))];
        let command = match self.text.split_once(' ') {
            Some(("no-such-program", _)) => vec!["no-such-program".to_owned()],
            _ => vec!["sh".to_owned(), "job.sh".to_owned()],
        };
        Ok(Input {
            files: files.map(|(name, text)| (name.to_owned(), text.into_bytes())).into(),
            command,
            environment: BTreeMap::from([("SCRIPT".to_owned(), "fake".to_owned())]),
            data: self.setup.iter().map(|original| ("setup".to_owned(), original.clone())).collect(),
        })
    }

    fn read(&self, structure: &Structure, directory: &Path, exit: Exit) -> Result<Calculated, Failure> {
        match exit {
            Exit::Code(0) => {}
            Exit::Code(3) => return Err(FailureClass::NotConverged.because("the script says so")),
            Exit::Code(4) => {
                return Err(FailureClass::OtherProgram.because("calculated by script 2, and not 1"));
            }
            exit => return Err(exit.failure()),
        }
        let text = fs::read_to_string(directory.join("energy")).unwrap_or_default();
        let energy = text.trim().parse().map_err(|_| FailureClass::Crashed.because("no energy"))?;
        Ok(Calculated {
            energy,
            forces: vec![[0.0; 3]; structure.len()],
            magnetic_moments: Some(vec![0.5; structure.len()]),
            electronic_steps: Some(7),
            ..Calculated::default()
        })
    }

    fn size(&self, structure: &Structure) -> Size {
        Size { atoms: structure.len(), electrons: 8.0, k_points: 27 }
    }
}

/// A campaign with structures to label, and a place for calculations.
struct Place {
    home: TempDir,
    store: Store,
    candidates: Vec<String>,
    running: Running,
    script: String,
    setup: Option<Original>,
}

impl Place {
    async fn new(structures: u64, script: &str) -> Self {
        let home = tempfile::tempdir().unwrap();
        let store = create(home.path()).await;
        let candidates = accept(&store, structures).await;
        let scratch = home.path().join("scratch");
        fs::create_dir(&scratch).unwrap();
        let running = Running { scratch: Some(scratch), cores: 3, ..Running::default() };
        // `begun` gets a line each time that the script is run, `go` lets it end.
        let here = home.path().display();
        let script = format!("echo $$ >> {here}/begun\n{script}").replace("$HERE", &here.to_string());
        Self { home, store, candidates, running, script, setup: None }
    }

    /// The same with a file of which calculations get copies, as `../data/setup`.
    async fn with_setup(structures: u64, script: &str, content: &str) -> Self {
        let place = Self::new(structures, script).await;
        fs::write(place.setup_path(), content).unwrap();
        let (original, _) = Original::hashed(place.setup_path()).unwrap();
        Self { setup: Some(original), ..place }
    }

    fn setup_path(&self) -> PathBuf {
        self.home.path().join("setup")
    }

    fn method(&self) -> Method {
        let script = Script { text: self.script.clone(), setup: self.setup.clone() };
        Method::kept_by(keeper_command(), Box::new(script), self.running.clone())
    }

    async fn labeller(&self) -> Labeller {
        self.labeller_with(|_| ()).await
    }

    async fn labeller_with(&self, change: impl FnOnce(&mut LabellerSettings)) -> Labeller {
        let process =
            ProcessRecord::new(ProcessRecord::LABELLER, Some(0), std::process::id(), unix_milliseconds());
        // Each is taken for another process.
        let process =
            ProcessRecord { id: format!("l{:?}", Instant::now()).replace(['/', ' '], ""), ..process };
        let mut settings = LabellerSettings {
            holder: process.id.clone(),
            protocol: protocol("dft"),
            attempts: 5,
            largest_force: 100.0,
            stay: Stay::UntilEmpty,
            timing: Timing {
                lease: Duration::from_secs(1),
                idle: Duration::from_millis(5),
                sign_of_life: Duration::from_millis(20),
                grace: None,
            },
        };
        change(&mut settings);
        let store = Store::open(self.home.path()).await.unwrap();
        let (method, closing) = (self.method(), Arc::new(Closing::default()));
        let (asked, id) = (Arc::clone(&closing), process.id.clone());
        let work =
            async move { serve(store, method, settings, process, &asked, unix_milliseconds, |_| ()).await };
        Labeller { id, closing, task: tokio::spawn(work) }
    }

    /// Labels everything.
    async fn work(&self) {
        self.labeller().await.ended().await.unwrap();
    }

    /// How often the script was begun.
    fn begun(&self) -> usize {
        let begun = fs::read_to_string(self.home.path().join("begun")).unwrap_or_default();
        begun.lines().count()
    }

    async fn wait_until_begun(&self, times: usize) {
        until("no calculation begins", async || self.begun() >= times).await;
    }

    fn go(&self) {
        fs::write(self.home.path().join("go"), "").unwrap();
    }

    async fn job(&self) -> JobDetails {
        self.store.queue_show(&self.candidates[0]).await.unwrap()
    }

    async fn attempts(&self) -> Vec<Attempt> {
        self.job().await.attempts_made
    }

    async fn labels(&self) -> Vec<LabelRecord> {
        let structure = self.store.known_hashes().await.unwrap()[0];
        self.store.label_history(structure, protocol("dft").hash).await.unwrap()
    }

    /// Process numbers of everything that calculations of this place have started and that still runs.
    fn processes(&self) -> Vec<u32> {
        let mark = format!("CALMWALK_CALCULATION={}", self.home.path().display());
        let numbers = fs::read_dir("/proc").unwrap().flatten();
        let numbers = numbers.filter_map(|entry| entry.file_name().to_str()?.parse().ok());
        let marked = |pid: &u32| {
            let environment = fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
            String::from_utf8_lossy(&environment).contains(&mark)
        };
        numbers.filter(marked).collect()
    }

    /// Directories of calculations.
    fn directories(&self) -> Vec<PathBuf> {
        let campaigns = fs::read_dir(self.running.scratch()).unwrap().flatten();
        campaigns
            .flat_map(|entry| fs::read_dir(entry.path()).unwrap())
            .map(|entry| entry.unwrap().path())
            .collect()
    }

    fn nothing_is_left(&self) {
        assert_eq!((self.processes(), self.directories()), (vec![], vec![]));
    }

    /// Whatever a check finds in it has to do with candidates, whose walks these tests do without.
    async fn is_consistent(&self) {
        let found = self.store.check(|_, _| ()).await.unwrap();
        assert!(found.len() == 1 && found[0].what.contains("candidates of walks"), "{found:?}");
    }

    /// Kills what keeps the only calculation that is under way.
    async fn kill_keeper(&self) {
        let attempts = self.attempts().await;
        let calculation = attempts.iter().rev().find_map(|attempt| attempt.calculation.clone()).unwrap();
        let calculation: serde_json::Value = serde_json::from_str(&calculation).unwrap();
        kill(calculation["pid"].as_u64().unwrap() as u32);
    }
}

struct Labeller {
    id: String,
    closing: Arc<Closing>,
    task: JoinHandle<Result<(), StoreError>>,
}

impl Labeller {
    async fn ended(self) -> Result<(), StoreError> {
        let ended = tokio::time::timeout(Duration::from_secs(60), self.task).await;
        ended.expect("the labeller does not go home").unwrap()
    }

    /// As kill -9 does: it does nothing any more, and its record goes with the next look at the processes.
    async fn kill(self, place: &Place) {
        self.task.abort();
        assert!(self.task.await.unwrap_err().is_cancelled());
        place.store.remove_process(&self.id).await.unwrap();
        assert_eq!(place.store.release_leases_of_gone_processes(unix_milliseconds()).await.unwrap(), 1);
    }
}

async fn until(or: &str, condition: impl AsyncFn() -> bool) {
    let begun = Instant::now();
    while !condition().await {
        assert!(begun.elapsed() < Duration::from_secs(60), "{or}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

fn kill(pid: u32) {
    let pid = rustix::process::Pid::from_raw(pid as i32).unwrap();
    rustix::process::kill_process(pid, rustix::process::Signal::KILL).unwrap();
}

fn outcomes(attempts: &[Attempt]) -> Vec<(&str, Option<&str>)> {
    attempts.iter().map(|a| (a.outcome.as_deref().unwrap(), a.class.as_deref())).collect()
}

/// Without what the keepers of these tests say before they become the program.
fn said(log: Option<&str>) -> String {
    log.unwrap().replace("running 1 test\n", "")
}

/// Ends when it may.
const WAITS: &str = "while [ ! -e $HERE/go ]; do sleep 0.01; done; echo -7.5 > energy";
/// The same, and what it starts in the background never ends by itself, also in a session of its own.
const WITH_CHILDREN: &str =
    "sleep 1000 & setsid sleep 1000 & while [ ! -e $HERE/go ]; do sleep 0.01; done; echo -7.5 > energy";

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_label_comes_with_all_that_is_known_of_it() {
    let script = "echo said; echo warned >&2; echo $SCRIPT $CALMWALK_CORES; sleep 0.2; echo -7.5 > energy";
    let place = Place::new(1, script).await;
    place.work().await;
    let labels = place.labels().await;
    assert_eq!((labels.len(), labels[0].standing, labels[0].label.energy), (1, Standing::Label, -7.5));
    let details = &labels[0].label.details;
    assert_eq!(
        (details.magnetic_moments.as_deref(), details.electronic_steps),
        (Some(&[0.5; ATOMS][..]), Some(7))
    );
    let attempts = place.attempts().await;
    let [attempt] = &attempts[..] else { panic!("{attempts:?}") };
    let made = &attempt.made;
    assert_eq!(
        (made.cores, made.atoms, made.electrons, made.k_points),
        (Some(3), Some(2), Some(8.0), Some(27))
    );
    assert_eq!((&made.remedies, &made.difference), (&None, &None));
    assert_eq!(said(attempt.log.as_deref()), "stdout:\nsaid\nfake 3\nstderr:\nwarned\n");
    // Its time on each of the three cores.
    let seconds = attempt.core_seconds.unwrap();
    let whole = 3.0 * (attempt.ended.unwrap() - attempt.started) as f64 / 1000.0;
    assert!((0.6..=whole + 0.01).contains(&seconds), "{seconds} of {whole}");
    let (_, used) = place.store.budget(unix_milliseconds()).await.unwrap();
    assert!((used.core_hours * 3600.0 - seconds).abs() < 1e-3, "{used:?}");
    place.is_consistent().await;
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_killed_labeller_began_is_finished_once() {
    let place = Place::new(1, WITH_CHILDREN).await;
    for killed in 1..=3 {
        let labeller = place.labeller().await;
        until("it is not begun or found", async || {
            let attempts = place.attempts().await;
            place.begun() == 1 && attempts.len() == killed && attempts.last().unwrap().calculation.is_some()
        })
        .await;
        labeller.kill(&place).await;
    }
    place.go();
    place.work().await;
    let attempts = place.attempts().await;
    assert_eq!((place.begun(), place.labels().await.len()), (1, 1), "{attempts:?}");
    let lost = ("lost", None);
    assert_eq!(outcomes(&attempts), [lost, lost, lost, ("labelled", None)]);
    // The calculation counts once.
    let seconds: Vec<_> = attempts.iter().map(|attempt| attempt.core_seconds).collect();
    assert_eq!(seconds[..3], [Some(0.0); 3]);
    let (_, used) = place.store.budget(unix_milliseconds()).await.unwrap();
    assert!((used.core_hours * 3600.0 - seconds[3].unwrap()).abs() < 1e-3, "{used:?}");
    place.is_consistent().await;
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_ended_while_nobody_waited_is_read_and_not_repeated() {
    let place = Place::new(1, WAITS).await;
    let labeller = place.labeller().await;
    place.wait_until_begun(1).await;
    labeller.kill(&place).await;
    place.go();
    until("it does not end", async || place.processes().is_empty()).await;
    place.work().await;
    assert_eq!((place.begun(), place.labels().await.len()), (1, 1));
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_left_of_a_calculation_without_a_keeper_is_ended_and_it_begins_again() {
    for labeller_lives in [true, false] {
        let place = Place::new(1, WITH_CHILDREN).await;
        let mut labeller = place.labeller().await;
        place.wait_until_begun(1).await;
        until("its children do not start", async || place.processes().len() >= 3).await;
        if labeller_lives {
            place.kill_keeper().await;
        } else {
            labeller.kill(&place).await;
            place.kill_keeper().await;
            labeller = place.labeller().await;
        }
        place.wait_until_begun(2).await;
        place.go();
        labeller.ended().await.unwrap();
        assert_eq!((place.begun(), place.labels().await.len()), (2, 1));
        let attempts = place.attempts().await;
        let class = labeller_lives.then_some("lost_node");
        assert_eq!(outcomes(&attempts), [("lost", class), ("labelled", None)]);
        assert_eq!(place.job().await.job.failures, 0);
        place.nothing_is_left();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_killed_program_is_a_failure_and_tried_again() {
    let place = Place::new(1, WITH_CHILDREN).await;
    let labeller = place.labeller().await;
    place.wait_until_begun(1).await;
    let begun = fs::read_to_string(place.home.path().join("begun")).unwrap();
    kill(begun.trim().parse().unwrap());
    place.wait_until_begun(2).await;
    place.go();
    labeller.ended().await.unwrap();
    let attempts = place.attempts().await;
    assert_eq!(outcomes(&attempts), [("failed", Some("crashed")), ("labelled", None)]);
    assert_eq!(place.labels().await.len(), 1);
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_is_stopped_ends_the_calculation_after_the_grace_and_gives_the_label_back() {
    let place = Place::new(1, WITH_CHILDREN).await;
    let grace = Some(Duration::from_millis(300));
    let labeller = place.labeller_with(|settings| settings.timing.grace = grace).await;
    place.wait_until_begun(1).await;
    labeller.closing.stop();
    labeller.ended().await.unwrap();
    assert_eq!(outcomes(&place.attempts().await), [("released", None)]);
    place.nothing_is_left();
    // One that may end does so.
    place.go();
    let labeller =
        place.labeller_with(|settings| settings.timing.grace = Some(Duration::from_secs(60))).await;
    place.wait_until_begun(2).await;
    labeller.closing.stop();
    labeller.ended().await.unwrap();
    assert_eq!((place.job().await.job.state, place.labels().await.len()), (JobState::Labelled, 1));
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_calculation_that_nobody_waits_for_any_more_is_ended() {
    let place = Place::new(1, WITH_CHILDREN).await;
    let labeller = place.labeller().await;
    place.wait_until_begun(1).await;
    let now = unix_milliseconds();
    place.store.release_all(&labeller.id, now).await.unwrap();
    let other = place.store.lease(protocol("dft").hash, "other", now, 600).await.unwrap().unwrap();
    assert_eq!(other.earlier_calculations.len(), 1);
    place.store.complete(&other, &label(-1.0), now).await.unwrap();
    labeller.ended().await.unwrap();
    let labels = place.labels().await;
    assert_eq!((labels.len(), labels[0].label.energy), (1, -1.0));
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_failure_climbs_its_ladder_with_everything_written_down() {
    let script = "cat remedies; grep -q other_algorithm remedies || exit 3; echo -7.5 > energy";
    let place = Place::new(1, script).await;
    place.work().await;
    let attempts = place.attempts().await;
    let failed = ("failed", Some("not_converged"));
    assert_eq!(outcomes(&attempts), [failed, failed, ("labelled", None)]);
    let remedies: Vec<_> = attempts.iter().map(|attempt| attempt.made.remedies.as_deref()).collect();
    assert_eq!(
        remedies,
        [None, Some("more_steps,slower_mixing"), Some("more_steps,slower_mixing,other_algorithm")]
    );
    assert_eq!(
        attempts[1].made.difference.as_deref(),
        Some("remedies: - \nremedies: + more_steps slower_mixing")
    );
    let log = said(attempts[1].log.as_deref());
    assert_eq!(log, "not converged: the script says so\nstdout:\nfirst\nmore_steps slower_mixing");
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_no_remedy_helps_against_is_given_up_and_others_go_on() {
    let place = Place::new(2, "[ $(cat $HERE/begun | wc -l) -gt 4 ] || exit 3; echo -7.5 > energy").await;
    let attempts = |settings: &mut LabellerSettings| settings.attempts = 100;
    place.labeller_with(attempts).await.ended().await.unwrap();
    // Three rungs, and the first try.
    let job = place.job().await;
    assert_eq!((job.job.state, job.job.attempts), (JobState::Failed, 4));
    let other = place.store.queue_show(&place.candidates[1]).await.unwrap();
    assert_eq!((other.job.state, other.job.attempts), (JobState::Labelled, 1));
    // By hand it begins anew.
    place.store.retry_job(&place.candidates[0], 0).await.unwrap();
    place.work().await;
    let job = place.job().await;
    assert_eq!((job.job.state, job.job.overruled), (JobState::Labelled, true));
    assert_eq!(job.attempts_made[4].made.remedies, None);
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_time_limit_ends_everything_and_is_doubled_once() {
    let mut place = Place::new(1, "sleep 1000 & setsid sleep 1000 & sleep 1000").await;
    place.running.time_limit = 0.4;
    place.work().await;
    let attempts = place.attempts().await;
    let failed = ("failed", Some("time_limit"));
    assert_eq!(outcomes(&attempts), [failed, failed]);
    assert_eq!(attempts[1].made.remedies.as_deref(), Some("more_time"));
    let seconds: Vec<_> = attempts.iter().map(|attempt| attempt.core_seconds.unwrap() / 3.0).collect();
    assert!(seconds[0] >= 0.4 && seconds[1] >= 0.8, "{seconds:?}");
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_has_to_end_is_asked_first_and_then_killed() {
    let script = "trap 'echo asked >> $HERE/asked' TERM; while true; do sleep 1000; done";
    let mut place = Place::new(1, script).await;
    place.running.time_limit = 0.4;
    place.work().await;
    assert_eq!(outcomes(&place.attempts().await), [("failed", Some("time_limit")); 2]);
    assert_eq!(fs::read_to_string(place.home.path().join("asked")).unwrap(), "asked\nasked\n");
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn too_much_memory_of_all_processes_together_ends_it() {
    // `tail` keeps a line that never ends; two of them have twice as much.
    let hungry = "head -c 60000000 /dev/zero | tail -n 1 | { sleep 2; cat > /dev/null; }";
    let mut place = Place::new(1, &format!("({hungry}) & ({hungry}) & wait; echo -7.5 > energy")).await;
    place.running.memory = Some(0.09);
    place.work().await;
    let attempts = place.attempts().await;
    assert_eq!(outcomes(&attempts), [("failed", Some("out_of_memory")), ("labelled", None)]);
    assert_eq!(attempts[1].made.remedies.as_deref(), Some("more_memory"));
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn directories_of_failures_are_kept_in_the_store() {
    let script =
        "mkdir deep; echo x > deep/file; head -c 20000000 /dev/zero > large; echo Zr > POTCAR; exit 3";
    for (keep, archives) in [(Keep::Nothing, 0), (Keep::Failed, 4), (Keep::All, 4)] {
        let mut place = Place::new(1, script).await;
        place.running.keep = keep;
        place.work().await;
        let job = place.job().await.job.job;
        let kept = place.store.archives(job).await.unwrap();
        assert_eq!(kept.len(), archives);
        place.nothing_is_left();
        let Some(archive) = kept.first() else { continue };
        let left_out = "work/POTCAR (3 bytes)\nwork/large (20000000 bytes)\n";
        assert_eq!((archive.attempt, archive.left_out.as_str()), (1, left_out));
        let mut unpacked = tar::Archive::new(zstd::Decoder::new(&archive.bytes[..]).unwrap());
        let paths = unpacked.entries().unwrap().map(|entry| entry.unwrap().path().unwrap().into_owned());
        let names: Vec<_> = paths.map(|path| path.display().to_string()).collect();
        assert!(
            names.contains(&"work/deep/file".to_owned()) && names.contains(&"end.json".to_owned()),
            "{names:?}"
        );
        place.is_consistent().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_program_that_cannot_be_started_is_the_hosts_fault_and_not_the_jobs() {
    let mut place = Place::new(1, "").await;
    place.script = "no-such-program at all".to_owned();
    let error = place.labeller().await.ended().await.unwrap_err();
    assert!(error.to_string().contains("cannot use no-such-program"), "{error}");
    let job = place.job().await;
    assert_eq!((job.job.state, job.job.failures), (JobState::Queued, 0));
    place.script = "echo -7.5 > energy".to_owned();
    place.work().await;
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn another_version_of_a_program_is_the_hosts_fault_and_not_the_jobs() {
    let mut place = Place::new(1, "exit 4").await;
    let error = place.labeller().await.ended().await.unwrap_err();
    assert_eq!(error.to_string(), "cannot use sh (calculated by script 2, and not 1)");
    let job = place.job().await;
    assert_eq!((job.job.state, job.job.failures), (JobState::Queued, 0));
    place.script = "echo -7.5 > energy".to_owned();
    place.work().await;
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_file_that_is_replaced_between_two_labels_ends_the_labeller() {
    let script = "cat ../data/setup > energy; echo -8.5 > $HERE/new; mv $HERE/new $HERE/setup";
    let place = Place::with_setup(2, script, "-7.5\n").await;
    let error = place.labeller().await.ended().await.unwrap_err().to_string();
    let path = place.setup_path().display().to_string();
    let (new, _) = Original::hashed(place.setup_path()).unwrap();
    let [found, expected] = [&new, place.setup.as_ref().unwrap()].map(|original| &original.hash()[..12]);
    let begin = format!(
        "cannot use {path} (its content has changed: BLAKE3 {found}…, where the protocol of the labels has {expected}…;"
    );
    assert!(error.starts_with(&begin), "{error}");
    assert_eq!((place.begun(), place.labels().await[0].label.energy), (1, -7.5));
    let second = async || place.store.queue_show(&place.candidates[1]).await.unwrap();
    let job = second().await;
    assert_eq!((job.job.state, job.job.failures), (JobState::Queued, 0));
    assert_eq!(job.attempts_made[0].calculation, None);
    place.nothing_is_left();
    let once = label_once(&place.method(), &structure(0.0), 100.0).await.map(drop).unwrap_err();
    assert_eq!(once.to_string(), error);
    // The file of the protocol comes back.
    fs::write(place.setup_path(), "-7.5\n").unwrap();
    place.work().await;
    assert_eq!((place.begun(), second().await.job.state), (2, JobState::Labelled));
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_under_way_has_a_copy_of_its_own() {
    let script = "while [ ! -e $HERE/go ]; do sleep 0.01; done; cat ../data/setup > energy";
    let place = Place::with_setup(1, script, "-7.5\n").await;
    let labeller = place.labeller().await;
    place.wait_until_begun(1).await;
    labeller.kill(&place).await;
    fs::write(place.setup_path(), "-8.5\n").unwrap();
    place.go();
    // Who comes next finds it, and has nothing to copy.
    place.work().await;
    assert_eq!((place.begun(), place.labels().await[0].label.energy), (1, -7.5));
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn copies_of_files_are_not_kept_in_the_store() {
    let mut place = Place::with_setup(1, "cat ../data/setup > energy", "-7.5\n").await;
    place.running.keep = Keep::All;
    place.work().await;
    let kept = place.store.archives(place.job().await.job.job).await.unwrap();
    assert_eq!(kept[0].left_out, "data/setup (5 bytes)\n");
    let mut unpacked = tar::Archive::new(zstd::Decoder::new(&kept[0].bytes[..]).unwrap());
    let names = unpacked.entries().unwrap().map(|entry| entry.unwrap().path().unwrap().display().to_string());
    let names: Vec<_> = names.collect();
    assert!(
        names.contains(&"work/energy".to_owned()) && !names.iter().any(|name| name.contains("setup")),
        "{names:?}"
    );
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_structure_is_labelled_without_a_campaign() {
    let place = Place::new(1, "echo said; sleep 0.1; echo -7.5 > energy").await;
    let once = label_once(&place.method(), &structure(0.0), 100.0).await.unwrap();
    assert_eq!(once.result.unwrap().energy, -7.5);
    assert!(
        once.core_seconds >= 0.3 && said(Some(&once.log)) == "stdout:\nsaid\n",
        "{} {}",
        once.core_seconds,
        once.log
    );
    let failing = Place::new(1, "echo said; exit 3").await;
    let once = label_once(&failing.method(), &structure(0.0), 100.0).await.unwrap();
    assert_eq!(
        (once.result.unwrap_err().class, said(Some(&once.log)).as_str()),
        (FailureClass::NotConverged, "stdout:\nsaid\n")
    );
    for place in [place, failing] {
        assert_eq!(place.processes(), [0_u32; 0]);
        assert_eq!(fs::read_dir(place.running.scratch()).unwrap().count(), 0);
    }
}
