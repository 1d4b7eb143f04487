//! Other processes of these tests: this test binary, with a role from its environment.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

use atoms::{Cell, Species, Structure};
use rustix::process::{Signal, set_parent_process_death_signal};
use serde::{Deserialize, Serialize};
use tokio_util::sync::CancellationToken;
use wire::ipc::{ConnectInfo, IpcWalker};
use wire::messages::{Assignment, AssignmentReport, Outcome};
use wire::transport::Transport;
use wire::{CampaignId, Candidate, CandidateId, ContentHash, Origin, WalkConditions, WalkId};

use super::test_server::TestServer;

const ROLE: &str = "CALMWALK_TEST_ROLE";
/// File that [`Role::Orchestrator`] creates in its directory when an assignment is done.
pub const AT_WORK: &str = "at-work";

/// Role of a process.
#[derive(Serialize, Deserialize)]
pub enum Role {
    /// Ends each assignment with [`candidate`] until it is shut down.
    Walker(ConnectInfo),
    /// Takes an assignment and hangs.
    Stuck(ConnectInfo),
    /// An orchestrator of the campaign in this directory, with a busy walker.
    Orchestrator(String),
}

/// Starts a process.
pub fn start(role: &Role) -> Child {
    Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "ipc::process::child", "--ignored", "--nocapture"])
        .env(ROLE, serde_json::to_string(role).unwrap())
        .stdout(Stdio::null())
        .spawn()
        .unwrap()
}

/// Not a test: the entry point of processes started by [`start`].
#[test]
#[ignore = "run by the others"]
fn child() {
    let Ok(role) = std::env::var(ROLE) else { return };
    set_parent_process_death_signal(Some(Signal::KILL)).unwrap();
    match serde_json::from_str(&role).unwrap() {
        Role::Walker(door) => walk(&door, false),
        Role::Stuck(door) => walk(&door, true),
        Role::Orchestrator(directory) => orchestrate(&directory),
    }
}

fn walk(door: &ConnectInfo, stuck: bool) {
    let mut walker = IpcWalker::connect(door, CancellationToken::new()).unwrap();
    let mut report = None;
    while let Some(work) = walker.exchange(report.take()) {
        let Assignment { walk, number, .. } = work.assignment;
        let candidate = candidate(&work.assignment);
        let (checkpoint, progress) = (number.to_le_bytes().to_vec(), progress(number));
        walker.progress(walk, progress.clone());
        assert_eq!(work.mixture.version(), number, "the version of the assignment");
        if stuck {
            sleep(Duration::MAX);
        }
        let outcome = Outcome::Candidate(candidate);
        report = Some(AssignmentReport {
            walk,
            assignment: number,
            start: None,
            outcome,
            checkpoint,
            progress,
            trace: vec![],
            frames: vec![],
        });
    }
    assert!(walker.failure().is_none(), "{:?}", walker.failure());
}

#[expect(clippy::zombie_processes, reason = "killed, and its walker with it")]
fn orchestrate(directory: &str) {
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let mut server = TestServer::open(Path::new(directory), 2, 1 << 16);
        let _walker = server.start(0, 1, Role::Walker);
        let mut last = server.offer().await;
        for number in 1.. {
            last = server.go_on(last, number, (2, 3)).await;
            if number == 1 {
                std::fs::write(Path::new(directory).join(AT_WORK), "").unwrap();
            }
        }
    });
}

pub fn progress(step: u64) -> wire::messages::WalkProgress {
    wire::messages::WalkProgress { step, ..Default::default() }
}

/// An assignment that ends with a candidate of this number of atoms and features.
pub fn assignment(walk: u32, number: u64, (atoms, features): (usize, usize)) -> Assignment {
    let walk = WalkId(walk);
    Assignment {
        campaign: CampaignId([7; 16]),
        walk,
        number,
        origin: Origin::Biased,
        random_walk: walk,
        seed_structure: structure(atoms),
        conditions: WalkConditions::default(),
        checkpoint: Some(vec![number as u8; 100]),
        verdict: None,
        last_step: features as u64,
        frame_steps: Vec::new(),
        threshold_factor: 1.0,
    }
}

fn structure(atoms: usize) -> Structure {
    let positions = (0..atoms).map(|k| [4.0 * k as f64, 0.25, 0.5]).collect();
    let cell = Cell([[4.0 * atoms as f64, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 4.0]]);
    let species = vec![Species::from_atomic_number(13).unwrap(); atoms];
    Structure { species, positions, cell, periodic: [true; 3] }
}

/// The candidate that ends this assignment.
pub fn candidate(assignment: &Assignment) -> Candidate {
    let Assignment { campaign, walk, number, ref seed_structure, last_step: features, .. } = *assignment;
    let n = seed_structure.len();
    let numbers = |count: usize, shift: f64| (0..count).map(|k| k as f64 + shift + number as f64).collect();
    let content = ContentHash::from_structure(seed_structure);
    Candidate {
        id: CandidateId { campaign, walk, segment: 0, step: number, content },
        origin: Origin::Biased,
        mixture_version: number,
        temperature: 300.0,
        relative_volume: 1.0,
        energy: number as f64,
        virial: [[1.0; 3]; 3],
        structure: seed_structure.clone(),
        forces: vec![[0.5; 3]; n],
        gamma: numbers(n, 0.1),
        gamma_nbr: numbers(n, 0.2),
        features: numbers(n * features as usize, 0.3),
    }
}
