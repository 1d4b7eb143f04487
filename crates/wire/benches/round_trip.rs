//! Round trip walker → server → walker. A walker's process sends candidates, and a task answers immediately.
//! `cargo bench -p wire --bench round_trip`
//!
//! `encode` is the walker's share: encoding control message and candidate. `check` is the server's share: checksums,
//! content hash, decoding. The rest is the transport: two wakeups of sleeping processes, the answer, and releasing the
//! old report. The total is the time a walker waits. For comparison, a byte is sent to `cat` and back through pipes:
//! two wakeups without anything else. All is measured with busy processors, as in a campaign, and with idle ones, which
//! take longer to wake.

use std::io::{Read, Write};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::thread::available_parallelism;
use std::time::{Duration, Instant};

use atoms::{Cell, Species, Structure};
use calm::{Component, Mixture};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use wire::ipc::{ConnectInfo, IpcServer, IpcWalker, Sizes, space_needed};
use wire::messages::{Assignment, AssignmentReport, Outcome, WalkProgress};
use wire::mixture::SharedMixture;
use wire::shm_dir::ShmDir;
use wire::transport::{Incoming, Transport, WorkItem};
use wire::{CampaignId, Candidate, CandidateId, ContentHash, Origin, WalkConditions, WalkId};

const DOOR: &str = "CALMWALK_BENCH_DOOR";
const TRIPS: usize = 2_000;
/// Number of round trips before the measurement, in which memory is first accessed.
const WARM_UP: usize = 100;

/// Atoms and features: 1 kB to 4 MB. The fourth has the size of a candidate in the paper.
const SIZES: [(usize, usize); 6] = [(8, 4), (32, 24), (108, 32), (108, 131), (500, 131), (1000, 515)];

/// Size of a checkpoint of 108 atoms, bytes. It is part of every report and assignment.
const CHECKPOINT: usize = 20_000;

fn main() {
    match std::env::var(DOOR) {
        Ok(door) => walk(&serde_json::from_str(&door).expect("a door")),
        Err(_) => {
            let runtime = tokio::runtime::Runtime::new().expect("a runtime");
            let work = AtWork::on_all_processors();
            println!("processors at work");
            runtime.block_on(orchestrate());
            drop(work);
            println!("idle processors");
            runtime.block_on(orchestrate());
        }
    }
}

/// Low-priority processes that keep every processor busy.
struct AtWork(Vec<Child>);

impl AtWork {
    fn on_all_processors() -> Self {
        let spin = |_| {
            let mut nice = Command::new("nice");
            nice.args(["-n", "19", "sh", "-c", "while :; do :; done"]).spawn().expect("nice and sh")
        };
        Self((0..available_parallelism().map_or(1, usize::from)).map(spin).collect())
    }
}

impl Drop for AtWork {
    fn drop(&mut self) {
        for process in &mut self.0 {
            process.kill().expect("a process of ours");
            process.wait().expect("a process of ours");
        }
    }
}

/// Sends a byte to another process and back.
fn bare_wake_ups() {
    let mut cat =
        Command::new("cat").stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("cat is there");
    let (mut there, mut back) = (cat.stdin.take().expect("a pipe"), cat.stdout.take().expect("a pipe"));
    let trip = |_| {
        let begin = Instant::now();
        there.write_all(b"x").expect("a living cat");
        back.read_exact(&mut [0]).expect("a living cat");
        begin.elapsed()
    };
    let (median, worst) = quantiles((0..TRIPS).map(trip).collect());
    drop(there);
    cat.wait().expect("cat ends");
    println!("  bare wake-ups through pipes: {median:.1} µs ({worst:.1})");
}

/// The walker's process: all sizes in sequence.
fn walk(door: &ConnectInfo) {
    let mut walker = IpcWalker::connect(door, CancellationToken::new()).expect("an orchestrator");
    let mut checked = walker.exchange(None).expect("an assignment").assignment.number;
    println!("    bytes   whole µs (99 %)     encode   check   transport µs (99 %)");
    for (atoms, features) in SIZES {
        let candidate = candidate(atoms, features);
        let mut times = Vec::with_capacity(TRIPS);
        for trip in 0..WARM_UP + TRIPS {
            let outcome = Outcome::Candidate(candidate.clone());
            let checkpoint = vec![0; CHECKPOINT];
            let progress = WalkProgress::default();
            let (walk, assignment, trace, start) = (WalkId(0), trip as u64, Vec::new(), None);
            let report = AssignmentReport {
                walk,
                assignment,
                start,
                outcome,
                checkpoint,
                progress,
                trace,
                frames: Vec::new(),
            };
            let (begin, encoding) = (Instant::now(), walker.encoding());
            let work = walker.exchange(Some(report)).expect("an assignment");
            let (whole, encode) = (begin.elapsed(), walker.encoding() - encoding);
            // The server's time is encoded in the number of the assignment.
            let check = Duration::from_nanos(
                work.assignment.number - std::mem::replace(&mut checked, work.assignment.number),
            );
            if trip >= WARM_UP {
                times.push([whole, encode, check, whole.saturating_sub(encode + check)]);
            }
        }
        let column = |k: usize| quantiles(times.iter().map(|time| time[k]).collect());
        let [whole, encode, check, transport] = [0, 1, 2, 3].map(column);
        println!(
            "{:9} {:8.1} ({:6.1})  {:8.1} {:8.1}  {:8.1} ({:6.1})",
            candidate.encoded_len(),
            whole.0,
            whole.1,
            encode.0,
            check.0,
            transport.0,
            transport.1,
        );
    }
}

/// Median and 99th percentile, µs.
fn quantiles(mut times: Vec<Duration>) -> (f64, f64) {
    times.sort_unstable();
    let at = |share: f64| times[(share * (times.len() - 1) as f64) as usize].as_secs_f64() * 1e6;
    (at(0.5), at(0.99))
}

async fn orchestrate() {
    tokio::task::spawn_blocking(bare_wake_ups).await.expect("a measurement");
    let directory = tempfile::tempdir().expect("a directory");
    let place = ShmDir::for_campaign(directory.path()).expect("a place");
    let sizes = Sizes { walkers: 1, message_bytes: 5 << 20 };
    let prepared = place.prepare(space_needed(&sizes)).expect("enough shared memory");
    let mut mixtures = SharedMixture::create(&place.mixture(), &mixture(), 1).expect("a shared mixture");
    mixtures.publish_original(&mixture()).expect("room for it");
    let server = IpcServer::open(&place, sizes, 1).expect("a transport");
    let handle = server.handle();
    handle.expect(0, 1);
    let door = serde_json::to_string(&handle.connect_info(0, 1)).expect("plain data");
    let (to_reactor, mut incoming) = mpsc::channel(64);
    let running = tokio::spawn(server.run(mixtures, to_reactor, |_, _| {}));
    let clock = handle.clone();
    let deciding = tokio::spawn(async move {
        let mixture = Arc::new(mixture());
        while let Some(incoming) = incoming.recv().await {
            if let Incoming::Idle { report, reply, .. } = incoming {
                drop(report);
                let checking = clock.traffic().checking.as_nanos() as u64;
                let _ = reply
                    .send(Some(WorkItem { assignment: assignment(checking), mixture: Arc::clone(&mixture) }));
            }
        }
    });
    let this = std::env::current_exe().expect("this program");
    let mut walker = Command::new(this).env(DOOR, door).stdin(Stdio::null()).spawn().expect("a process");
    tokio::task::spawn_blocking(move || walker.wait()).await.expect("a wait").expect("a process");
    handle.lost(0, 1, false);
    handle.close();
    running.await.expect("a task").expect("a transport");
    deciding.await.expect("a task");
    drop(prepared);
    println!("{:?}, {:?} removed", handle.traffic(), place.remove().expect("a place"));
}

fn structure(atoms: usize) -> Structure {
    let positions = (0..atoms).map(|k| [4.0 * k as f64, 0.25, 0.5]).collect();
    let cell = Cell([[4.0 * atoms as f64, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 4.0]]);
    let species = vec![Species::from_atomic_number(13).expect("aluminium"); atoms];
    Structure { species, positions, cell, periodic: [true; 3] }
}

/// The next assignment.
fn assignment(number: u64) -> Assignment {
    Assignment {
        campaign: CampaignId([7; 16]),
        walk: WalkId(0),
        number,
        origin: Origin::Biased,
        random_walk: WalkId(0),
        seed_structure: structure(108),
        conditions: WalkConditions::default(),
        checkpoint: Some(vec![1; CHECKPOINT]),
        verdict: None,
        last_step: 1000,
        frame_steps: Vec::new(),
        threshold_factor: 1.0,
    }
}

fn candidate(atoms: usize, features: usize) -> Candidate {
    let structure = structure(atoms);
    let numbers = |count: usize| (0..count).map(|k| (k as f64).sin()).collect();
    let content = ContentHash::from_structure(&structure);
    Candidate {
        id: CandidateId { campaign: CampaignId([7; 16]), walk: WalkId(0), segment: 0, step: 1, content },
        origin: Origin::Biased,
        mixture_version: 1,
        temperature: 300.0,
        relative_volume: 1.0,
        energy: -1.0,
        virial: [[1.0; 3]; 3],
        structure,
        forces: vec![[0.5; 3]; atoms],
        gamma: numbers(atoms),
        gamma_nbr: numbers(atoms),
        features: numbers(atoms * features),
    }
}

fn mixture() -> Mixture {
    Mixture::new(1, vec![vec![Arc::new(Component::unknown_element(2))]]).expect("a mixture")
}
