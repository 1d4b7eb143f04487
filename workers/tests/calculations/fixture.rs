//! A campaign whose labels are made by a script.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use atoms::{Species, Structure};
use dft::{
    CalculationInput, CalculationResults, CalculationSize, DftBackend, Exit, Failure, FailureClass,
    PinnedFile, RetryAdjustment, SetupError, result_file,
};
use serde_json::json;
use store::{Attempt, JobDetails, LabelRecord, ProcessRecord, Store, StoreError, unix_milliseconds};
use tempfile::TempDir;
use tokio::task::JoinHandle;
use workers::labeller::{
    ExecutionSettings, ExitPolicy, LabelBounds, LabellerSettings, Method, RunnerCommand, Shutdown, Timing,
    serve,
};

use crate::common::*;

pub fn runner_command() -> RunnerCommand {
    // With one thread, the name of the test would precede the output of the code.
    let arguments = ["calculations::runner", "--exact", "--ignored", "--nocapture", "--test-threads=2"];
    let arguments = arguments.map(str::to_owned).to_vec();
    RunnerCommand { program: std::env::current_exe().unwrap(), arguments }
}

/// A shell script: exit code 0 means a label with the energy in the file `energy`, 3 means not converged.
pub struct Script {
    text: String,
    /// A file of which it gets a copy.
    setup: Option<PinnedFile>,
    /// As long as there is a file of this name, reading results blocks.
    slow: PathBuf,
}

impl DftBackend for Script {
    fn identity(&self) -> serde_json::Value {
        json!(self.text)
    }

    fn supports(&self, _: &BTreeSet<Species>) -> Result<(), SetupError> {
        Ok(())
    }

    fn input(
        &self,
        _: &Structure,
        remedies: &BTreeSet<RetryAdjustment>,
    ) -> Result<CalculationInput, Failure> {
        let names: Vec<_> = remedies.iter().map(|remedy| remedy.name()).collect();
        let files = [("job.sh", self.text.clone()), ("remedies", format!("first\n{}\n", names.join(" ")))];
        let command = match self.text.split_once(' ') {
            Some(("no-such-program", _)) => vec!["no-such-program".to_owned()],
            _ => vec!["sh".to_owned(), "job.sh".to_owned()],
        };
        Ok(CalculationInput {
            files: files.map(|(name, text)| (name.to_owned(), text.into_bytes())).into(),
            command,
            environment: BTreeMap::from([("SCRIPT".to_owned(), "fake".to_owned())]),
            data: self.setup.iter().map(|original| ("setup".to_owned(), original.clone())).collect(),
        })
    }

    fn read(
        &self,
        structure: &Structure,
        directory: &Path,
        exit: Exit,
    ) -> Result<CalculationResults, Failure> {
        match exit {
            Exit::Code(0) => {}
            Exit::Code(3) => return Err(FailureClass::NotConverged.with_message("the script says so")),
            Exit::Code(4) => {
                return Err(FailureClass::OtherProgram.with_message("calculated by script 2, and not 1"));
            }
            exit => return Err(exit.failure()),
        }
        // Like a file system that does not respond.
        while self.slow.exists() {
            std::thread::sleep(Duration::from_millis(5));
        }
        let text = result_file::read(&directory.join("energy")).unwrap_or_default();
        let energy = String::from_utf8_lossy(&text)
            .trim()
            .parse()
            .map_err(|_| FailureClass::Crashed.with_message("no energy"))?;
        Ok(CalculationResults {
            energy,
            forces: vec![[0.0; 3]; structure.len()],
            magnetic_moments: Some(vec![0.5; structure.len()]),
            electronic_steps: Some(7),
            ..CalculationResults::default()
        })
    }

    fn size(&self, structure: &Structure) -> CalculationSize {
        CalculationSize { atoms: structure.len(), electrons: 8.0, k_points: 27 }
    }
}

/// A campaign with structures to label, and a directory for calculations.
pub struct Fixture {
    pub home: TempDir,
    pub store: Store,
    pub candidates: Vec<String>,
    pub running: ExecutionSettings,
    pub script: String,
    pub setup: Option<PinnedFile>,
}

impl Fixture {
    pub async fn new(structures: u64, script: &str) -> Self {
        let home = tempfile::tempdir().unwrap();
        let store = create(home.path()).await;
        let candidates = accept(&store, structures).await;
        let scratch = home.path().join("scratch");
        fs::create_dir(&scratch).unwrap();
        let running = ExecutionSettings { scratch: Some(scratch), cores: 3, ..ExecutionSettings::default() };
        // `begun` gets a line for each run of the script; `go` lets it end.
        let here = home.path().display();
        let script = format!("echo $$ >> {here}/begun\n{script}").replace("$HERE", &here.to_string());
        Self { home, store, candidates, running, script, setup: None }
    }

    /// The same with a file that calculations copy as `../data/setup`.
    pub async fn with_setup(structures: u64, script: &str, content: &str) -> Self {
        let fixture = Self::new(structures, script).await;
        fs::write(fixture.setup_path(), content).unwrap();
        let (original, _) = PinnedFile::open(fixture.setup_path()).unwrap();
        Self { setup: Some(original), ..fixture }
    }

    pub fn setup_path(&self) -> PathBuf {
        self.home.path().join("setup")
    }

    pub fn method(&self) -> Method {
        let script = Script {
            text: self.script.clone(),
            setup: self.setup.clone(),
            slow: self.home.path().join("slow"),
        };
        Method::with_runner(runner_command(), Box::new(script), self.running.clone())
    }

    pub async fn labeller(&self) -> Labeller {
        self.labeller_with(|_| ()).await
    }

    pub async fn labeller_with(&self, change: impl FnOnce(&mut LabellerSettings)) -> Labeller {
        let process =
            ProcessRecord::new(ProcessRecord::LABELLER, Some(0), std::process::id(), unix_milliseconds());
        // Each counts as a different process.
        let process =
            ProcessRecord { id: format!("l{:?}", Instant::now()).replace(['/', ' '], ""), ..process };
        let mut settings = LabellerSettings {
            holder: process.id.clone(),
            protocol: protocol("dft"),
            attempts: 5,
            bounds: LabelBounds::default(),
            exit_policy: ExitPolicy::UntilEmpty,
            timing: Timing {
                lease: Duration::from_secs(1),
                idle: Duration::from_millis(5),
                heartbeat_interval: Duration::from_millis(20),
                grace: None,
            },
        };
        change(&mut settings);
        let store = Store::open(self.home.path()).await.unwrap();
        let (method, shutdown) = (self.method(), Arc::new(Shutdown::default()));
        let (asked, id) = (Arc::clone(&shutdown), process.id.clone());
        let work =
            async move { serve(store, method, settings, process, &asked, unix_milliseconds, |_| ()).await };
        Labeller { id, shutdown, task: tokio::spawn(work) }
    }

    /// Labels everything.
    pub async fn work(&self) {
        self.labeller().await.ended().await.unwrap();
    }

    /// Number of runs of the script.
    pub fn begun(&self) -> usize {
        let begun = fs::read_to_string(self.home.path().join("begun")).unwrap_or_default();
        begun.lines().count()
    }

    pub async fn wait_until_begun(&self, times: usize) {
        until("no calculation begins", async || self.begun() >= times).await;
    }

    pub fn release(&self) {
        fs::write(self.home.path().join("go"), "").unwrap();
    }

    pub async fn job(&self) -> JobDetails {
        self.store.queue_show(&self.candidates[0]).await.unwrap()
    }

    pub async fn attempts(&self) -> Vec<Attempt> {
        self.job().await.attempts_made
    }

    pub async fn labels(&self) -> Vec<LabelRecord> {
        let structure = self.store.known_hashes().await.unwrap()[0];
        self.store.labels_of(structure).await.unwrap().into_iter().map(|label| label.record).collect()
    }

    /// Ids of running processes started by calculations of this fixture.
    pub fn processes(&self) -> Vec<u32> {
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
    pub fn directories(&self) -> Vec<PathBuf> {
        let campaigns = fs::read_dir(self.running.scratch()).unwrap().flatten();
        campaigns
            .flat_map(|entry| fs::read_dir(entry.path()).unwrap())
            .map(|entry| entry.unwrap().path())
            .collect()
    }

    pub fn nothing_is_left(&self) {
        assert_eq!((self.processes(), self.directories()), (vec![], vec![]));
    }

    /// Ignores findings about candidates, whose walks these tests lack.
    pub async fn is_consistent(&self) {
        let found = self.store.check(|_, _| ()).await.unwrap();
        assert!(found.len() == 1 && found[0].what.contains("candidates of missing walks"), "{found:?}");
    }

    /// Kills the runner of the only running calculation.
    pub async fn kill_runner(&self) {
        let attempts = self.attempts().await;
        let calculation = attempts.iter().rev().find_map(|attempt| attempt.calculation.clone()).unwrap();
        let calculation: serde_json::Value = serde_json::from_str(&calculation).unwrap();
        kill(calculation["pid"].as_u64().unwrap() as u32);
    }
}

pub struct Labeller {
    pub id: String,
    pub shutdown: Arc<Shutdown>,
    pub task: JoinHandle<Result<(), StoreError>>,
}

impl Labeller {
    pub async fn ended(self) -> Result<(), StoreError> {
        let ended = tokio::time::timeout(Duration::from_secs(60), self.task).await;
        ended.expect("the labeller does not exit").unwrap()
    }

    /// Like kill -9: it stops, and its record is removed with the next check of processes.
    pub async fn kill(self, fixture: &Fixture) {
        self.task.abort();
        assert!(self.task.await.unwrap_err().is_cancelled());
        fixture.store.remove_process(&self.id).await.unwrap();
        assert_eq!(fixture.store.release_leases_of_dead_processes(unix_milliseconds()).await.unwrap(), 1);
    }
}

pub async fn until(or: &str, condition: impl AsyncFn() -> bool) {
    let started = Instant::now();
    while !condition().await {
        assert!(started.elapsed() < Duration::from_secs(60), "{or}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

pub fn kill(pid: u32) {
    let pid = rustix::process::Pid::from_raw(pid as i32).unwrap();
    rustix::process::kill_process(pid, rustix::process::Signal::KILL).unwrap();
}

pub fn outcomes(attempts: &[Attempt]) -> Vec<(&str, Option<&str>)> {
    attempts.iter().map(|a| (a.outcome.as_deref().unwrap(), a.class.as_deref())).collect()
}

/// Without the output of this test's runners before they execute the program.
pub fn said(log: Option<&str>) -> String {
    log.unwrap().replace("running 1 test\n", "")
}

/// Ends when `go` exists.
pub const WAITS: &str = "while [ ! -e $HERE/go ]; do sleep 0.01; done; echo -7.5 > energy";
/// The same, with background processes that never end, one in its own session.
pub const WITH_CHILDREN: &str =
    "sleep 1000 & setsid sleep 1000 & while [ ! -e $HERE/go ]; do sleep 0.01; done; echo -7.5 > energy";
