//! A campaign on several hosts: an orchestrator and agents.

use std::collections::BTreeMap;
use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};

use tempfile::TempDir;
use wire::shm_dir::ShmDir;

use super::campaign::{Outcome, Small, outcome};
use super::processes::{assert_no_leftovers, processes_in, wait_until};
use super::{Running, program, through};

/// A campaign with the directories of its orchestrator and of each other host.
pub struct Hosts {
    pub home: TempDir,
    pub others: Vec<TempDir>,
    /// Where the orchestrator listens, and where agents connect.
    pub endpoints: [String; 2],
    /// Whether the orchestrator listens for agents.
    pub listens: bool,
    /// Further options of `run` and of `agent`.
    pub options: [Vec<String>; 2],
    /// Commands with arguments that start the orchestrator and the agents.
    pub through: [Vec<String>; 2],
}

impl Hosts {
    /// The orchestrator has one local walker. `keys` are added to the section `[run]`.
    pub fn new(small: &Small, others: usize, keys: &str) -> Self {
        let home = tempfile::tempdir().unwrap();
        let path = Small { walkers: 1, ..small.clone() }.write(home.path());
        let text = fs::read_to_string(&path).unwrap();
        fs::write(&path, text.replace("[run]\n", &format!("[run]\n{keys}\n"))).unwrap();
        Self::at(home, others)
    }

    /// The campaign in this directory.
    pub fn at(home: TempDir, others: usize) -> Self {
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let endpoint = format!("tcp/127.0.0.1:{port}");
        let others = (0..others).map(|_| tempfile::tempdir().unwrap()).collect();
        let endpoints = [endpoint.clone(), endpoint];
        let (options, through) = Default::default();
        Self { home, others, endpoints, listens: true, options, through }
    }

    pub fn start_orchestrator(&self) -> Running {
        let home = self.home.path();
        let mut command = through(&self.through[0], home);
        command.args(["run", "campaign.toml", "--directory", "."]);
        if self.listens {
            command.args(["--listen", &self.endpoints[0]]);
        }
        started(command.args(&self.options[0]), &home.join("said"))
    }

    /// Each agent has one walker.
    pub fn agent(&self, host: usize) -> Running {
        let directory = self.others[host].path();
        let mut command = through(&self.through[1], directory);
        command.env("TMPDIR", directory);
        command.args(["agent", "--join", &self.endpoints[1], "--walkers", "1"]).args(&self.options[1]);
        started(&mut command, &directory.join("said"))
    }

    /// Standard error of an agent.
    pub fn said(&self, host: usize) -> String {
        fs::read_to_string(self.others[host].path().join("said")).unwrap_or_default()
    }

    /// Standard error of the orchestrator.
    pub fn orchestrator_stderr(&self) -> String {
        fs::read_to_string(self.home.path().join("said")).unwrap_or_default()
    }

    /// Checks that all processes have exited and left no files behind.
    pub fn assert_cleaned_up(&self) {
        assert_no_leftovers(self.home.path());
        for host in &self.others {
            wait_until("all processes have exited", || processes_in(host.path()).is_empty());
            let left: Vec<PathBuf> =
                fs::read_dir(host.path()).unwrap().map(|entry| entry.unwrap().path()).collect();
            assert_eq!(left, [host.path().join("said")]);
            let here =
                |place: &ShmDir| place.campaign_directory().is_some_and(|of| of.starts_with(host.path()));
            assert!(!ShmDir::all().unwrap().iter().any(here));
        }
    }
}

/// Starts a program whose standard error is appended to a file.
pub fn started(command: &mut Command, said: &Path) -> Running {
    let said = fs::File::options().create(true).append(true).open(said).unwrap();
    Running(command.stdout(Stdio::null()).stderr(said).spawn().expect("the program starts"))
}

/// The outcome of a campaign, and how long it took.
pub type Ended = (Outcome, Duration);

/// The outcome of the campaign in a single process.
pub fn uninterrupted_outcome(small: &Small) -> Outcome {
    uninterrupted(small).0
}

/// The same, and how long the campaign took. A reproducible campaign has one outcome, so each is run once for all tests of a test
/// program.
pub fn uninterrupted(small: &Small) -> Ended {
    static OUTCOMES: Mutex<BTreeMap<Small, Arc<OnceLock<Ended>>>> = Mutex::new(BTreeMap::new());
    assert_eq!(small.mode, "reproducible", "only these campaigns have one outcome");
    // A single process starts no walkers.
    let small = Small { walkers: 1, ..small.clone() };
    let outcome = Arc::clone(OUTCOMES.lock().unwrap().entry(small.clone()).or_default());
    outcome.get_or_init(|| run_in_one_process(|directory| drop(small.write(directory)))).clone()
}

/// Runs the campaign that `write` writes into a directory.
pub fn run_in_one_process(write: impl FnOnce(&Path)) -> Ended {
    let directory = tempfile::tempdir().unwrap();
    write(directory.path());
    let mut command = program(directory.path());
    command.args(["run", "campaign.toml", "--directory", ".", "--in-process"]);
    let begun = Instant::now();
    let ended = command.stdout(Stdio::null()).stderr(Stdio::null()).status().unwrap();
    assert_eq!(ended.code(), Some(0));
    (outcome(directory.path()), begun.elapsed())
}
