//! Benchmark of a campaign with a million decisions and a million queued label jobs: the time to continue it, and the
//! cost of queries of the queue.
//!
//! `cargo bench -p orchestrator --bench scale`, with the number of decisions as an optional argument after `--`. Also
//! uses the PostgreSQL server at the URL in `CALMWALK_POSTGRES` if set, see `.ci/postgres`. Results are in
//! `docs/benchmarks.md`.
#![allow(dead_code, reason = "the other bench uses the rest of what they share")]

#[path = "../selector/campaign.rs"]
mod campaign;
#[path = "../selector/database.rs"]
mod database;
#[path = "../selector/random.rs"]
mod random;
#[path = "../selector/recording.rs"]
mod recording;

use std::sync::Arc;
use std::time::{Duration, Instant};

use atoms::{Cell, Structure};
use database::Database;
use orchestrator::selector::{Scheduling, Selector, SelectorSnapshot};
use recording::{CAMPAIGN, Model, crystal};
use store::{
    AtomGrades, CandidateRecord, Commit, ComponentRecord, Decision, Fate, JobState, Label, Location, Store,
};
use wire::{Candidate, CandidateBlock, CandidateId, ContentHash, Origin, WalkId};

const DECISIONS: usize = 1_000_000;
/// Decisions per commit.
const GROUP: usize = 1000;
const WALKS: usize = 1000;
/// Number of repetitions of each query.
const LOOKS: usize = 50;
/// Jobs per page.
const PAGE: u32 = 50;

fn main() {
    let decisions = std::env::args().skip(1).find_map(|text| text.parse().ok()).unwrap_or(DECISIONS);
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
    let model = Model::load();
    for database in Database::all() {
        println!("{}", database.name());
        let room = runtime.block_on(database.room());
        let filled = runtime.block_on(fill(&model, room.location.clone(), decisions));
        println!("  {decisions} decisions written in {:.0} s", filled.as_secs_f64());
        runtime.block_on(recover(&model, room.location.clone()));
        runtime.block_on(look_at_the_queue(room.location, decisions));
    }
}

/// Writes decisions that are all accepts, each with its job; then the walks with their checkpoints.
async fn fill(model: &Model, location: Location, decisions: usize) -> Duration {
    let store = campaign::create_store(location, WALKS).await;
    let begun = Instant::now();
    for first in (0..decisions).step_by(GROUP) {
        store.commit(&group(first..(first + GROUP).min(decisions))).await.unwrap();
    }
    let mut walks = campaign::selector(model, WALKS, &campaign::settings(1.5)).start_walks();
    for walk in &mut walks.walks {
        walk.checkpoint = Some(vec![1; campaign::CHECKPOINT]);
        walk.accepted = (decisions / WALKS) as u32;
    }
    let (.., component) = model.original.iter().next().expect("a mixture has components");
    walks.components.push(ComponentRecord { element: 0, slot: 0, bytes: component.to_bytes() });
    store.commit(&walks).await.unwrap();
    store.close().await;
    begun.elapsed()
}

fn group(numbers: std::ops::Range<usize>) -> Commit {
    let candidates: Vec<_> = numbers.map(record).collect();
    let decision = |record: &CandidateRecord| Decision {
        round: 0,
        kind: "accepted",
        walk: Some(record.block.view().id().walk),
        candidate: Some(record.block.view().id()),
        mixture_version: 1,
        detail: serde_json::json!({ "original": { "gamma_max": 2.0 } }),
    };
    Commit { decisions: candidates.iter().map(decision).collect(), candidates, ..Commit::default() }
}

/// Two atoms without features: small, and unique.
fn record(number: usize) -> CandidateRecord {
    let structure = Structure {
        species: crystal().species[..2].to_vec(),
        positions: vec![[1e-6 * number as f64, 0.0, 0.0], [2.0, 2.0, 2.0]],
        cell: Cell::orthorhombic(4.05, 4.05, 4.05),
        periodic: [true; 3],
    };
    let grades = AtomGrades { gamma: vec![2.0; 2], gamma_nbr: vec![1.5; 2] };
    let id = CandidateId {
        campaign: CAMPAIGN,
        walk: WalkId((number % WALKS) as u32),
        segment: 0,
        step: (number / WALKS) as u64,
        content: ContentHash::from_structure(&structure),
    };
    let block = CandidateBlock::encode(&Candidate {
        id,
        origin: Origin::Biased,
        mixture_version: 0,
        temperature: 300.0,
        relative_volume: 1.0,
        energy: -7.0,
        virial: [[0.0; 3]; 3],
        structure,
        forces: vec![[0.0; 3]; 2],
        gamma: grades.gamma.clone(),
        gamma_nbr: grades.gamma_nbr.clone(),
        features: Vec::new(),
    });
    CandidateRecord {
        block,
        fate: Fate::Accepted,
        seed_structure: id.walk.0,
        selector: grades.clone(),
        original: grades,
        keep_features: false,
        priority: (number % 3) as i32,
    }
}

/// From startup to the first assignment, as in `calmwalk run`, without the files of the configuration.
async fn recover(model: &Model, location: Location) {
    let begun = Instant::now();
    let store = Store::open(location).await.unwrap();
    let snapshot = SelectorSnapshot {
        walks: store.load_walks().await.unwrap(),
        components: store.load_components().await.unwrap(),
        known: store.known_hashes().await.unwrap(),
        imported: store.status().await.unwrap().imported,
        values: store.values().await.unwrap(),
    };
    let seeds = campaign::seed_structures(WALKS);
    let (grader, original) = (model.grader.clone(), Arc::clone(&model.original));
    let training = Some(model.training.clone());
    let settings = campaign::settings(1.5);
    let mut selector =
        Selector::restore(settings, CAMPAIGN, seeds, grader, original, training, snapshot).unwrap();
    selector.start_walks();
    assert!(matches!(selector.next_assignment(0), Scheduling::Assign(_)));
    println!("  gone on after {:.2} s", begun.elapsed().as_secs_f64());
    store.close().await;
}

async fn look_at_the_queue(location: Location, decisions: usize) {
    let store = Store::open(location).await.unwrap();
    let protocol = ContentHash([7; 32]);
    println!("  {:<44} {:>10} {:>10}", "ms", "median", "worst");
    looks("lease the next job", async || {
        drop(store.lease(protocol, "bench", store::unix_milliseconds(), 600).await.unwrap().unwrap())
    })
    .await;
    let label = Label { energy: -7.0, forces: vec![[0.0; 3]; 2], stress: None, details: Default::default() };
    looks("lease a job and complete it", async || {
        let lease = store.lease(protocol, "bench", store::unix_milliseconds(), 600).await.unwrap().unwrap();
        store.complete(&lease, &label, store::unix_milliseconds()).await.unwrap();
    })
    .await;
    looks("is there a job?", async || {
        assert!(store.has_pending_labels(store::unix_milliseconds()).await.unwrap())
    })
    .await;
    looks("how many are there?", async || assert!(store.unfinished_jobs().await.unwrap() > 0)).await;
    for state in [JobState::Queued, JobState::Leased, JobState::Labelled] {
        looks(&format!("list {PAGE} of those {state}"), async || {
            assert_eq!(store.queue_list(Some(state), PAGE, 0).await.unwrap().len(), PAGE as usize);
        })
        .await;
    }
    let deep = (decisions / 2) as u32;
    looks(&format!("list {PAGE} after {deep}"), async || {
        assert_eq!(store.queue_list(Some(JobState::Queued), PAGE, deep).await.unwrap().len(), PAGE as usize);
    })
    .await;
    let some = store.queue_list(Some(JobState::Queued), 1, deep).await.unwrap().remove(0).candidate;
    looks("show one by its name", async || drop(store.queue_show(&some).await.unwrap())).await;
    looks("status", async || drop(store.status().await.unwrap())).await;
    store.close().await;
}

async fn looks(what: &str, look: impl AsyncFn()) {
    let mut times = Vec::with_capacity(LOOKS);
    for _ in 0..LOOKS {
        let begun = Instant::now();
        look().await;
        times.push(1e3 * begun.elapsed().as_secs_f64());
    }
    times.sort_by(f64::total_cmp);
    println!("  {what:<44} {:>10.2} {:>10.2}", times[LOOKS / 2], times[LOOKS - 1]);
}
