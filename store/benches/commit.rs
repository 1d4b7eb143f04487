//! The cost of a commit: groups of candidates with 108 atoms and 130 features, each with its decision and its
//! walk's checkpoint. Half of them are accepted, with a label job and a component of the mixture.
//!
//! `cargo bench -p store --bench commit`; also on a PostgreSQL server if `CALMWALK_POSTGRES` is its URL, see
//! `.ci/postgres`. The results are in `docs/benchmarks.md`.

#[path = "../tests/common/mod.rs"]
mod common;

use std::time::{Duration, Instant};

use atoms::{Cell, Structure};
use common::{CAMPAIGN, commit_of, server, walk};
use sqlx::postgres::PgConnectOptions;
use sqlx::{AssertSqlSafe, ConnectOptions, Executor};
use store::{AtomGrades, CandidateRecord, Commit, ComponentRecord, Fate, Location};
use wire::messages::DeclineReason;
use wire::{Candidate, CandidateBlock, CandidateId, ContentHash, Origin, WalkId};

const ATOMS: usize = 108;
const FEATURES: usize = 130;
const CHECKPOINT: usize = 27_000;
/// A packed Cholesky factor and its header.
const COMPONENT: usize = 8 * FEATURES * (FEATURES + 1) / 2;
const CANDIDATES: usize = 512;

fn main() {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
    for group in [1, 8, 32, 64] {
        let commits: Vec<_> = (0..CANDIDATES / group).map(|k| commit(k * group, group)).collect();
        let directory = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
        report("SQLite", group, runtime.block_on(measure(directory.path().into(), &commits)));
        if std::env::var_os("CALMWALK_POSTGRES").is_some() {
            let location = format!("{}?schema=bench", server()).parse().unwrap();
            runtime.block_on(drop_schema());
            report("PostgreSQL", group, runtime.block_on(measure(location, &commits)));
            runtime.block_on(drop_schema());
        }
    }
}

fn report(database: &str, group: usize, time: Duration) {
    let each = 1e3 * time.as_secs_f64() / CANDIDATES as f64;
    println!("{database:<11} groups of {group:>2}: {each:.2} ms a candidate, {:.0}/s", 1e3 / each);
}

async fn measure(location: Location, commits: &[Commit]) -> Duration {
    let store = common::create_at(location).await;
    let started = Instant::now();
    for commit in commits {
        store.commit(commit).await.unwrap();
    }
    let time = started.elapsed();
    store.close().await;
    time
}

async fn drop_schema() {
    let options: PgConnectOptions = server().parse().unwrap();
    let sql = AssertSqlSafe("DROP SCHEMA IF EXISTS bench CASCADE");
    options.connect().await.unwrap().execute(sql).await.unwrap();
}

/// A group of candidates numbered from `first`.
fn commit(first: usize, group: usize) -> Commit {
    let records: Vec<_> = (first..first + group).map(record).collect();
    let walks = (0..group as u32).map(|k| {
        let checkpoint =
            Some(noise(first as u64, CHECKPOINT / 8).iter().flat_map(|x| x.to_le_bytes()).collect());
        store::WalkRecord { checkpoint, ..walk(k, first as u64) }
    });
    let walks = walks.collect();
    let components = (0..group as u32 / 2).map(|slot| ComponentRecord {
        element: 0,
        slot,
        bytes: noise(first as u64, COMPONENT / 8).iter().flat_map(|x| x.to_le_bytes()).collect(),
    });
    let components = components.collect();
    Commit { walks, components, values: vec![("round".into(), first.to_string())], ..commit_of(records) }
}

fn record(number: usize) -> CandidateRecord {
    let positions = noise(number as u64, 3 * ATOMS).as_chunks().0.to_vec();
    let structure = Structure {
        species: vec!["Al".parse().unwrap(); ATOMS],
        positions,
        cell: Cell::orthorhombic(12.15, 12.15, 12.15),
        periodic: [true; 3],
    };
    let grades = || AtomGrades { gamma: noise(1, ATOMS), gamma_nbr: noise(2, ATOMS) };
    let content = ContentHash::from_structure(&structure);
    let block = CandidateBlock::encode(&Candidate {
        id: CandidateId { campaign: CAMPAIGN, walk: WalkId(0), segment: 0, step: number as u64, content },
        origin: Origin::Biased,
        mixture_version: 3,
        temperature: 300.25,
        relative_volume: 1.01,
        energy: -8.5,
        virial: [[1.0; 3]; 3],
        structure,
        forces: noise(3, 3 * ATOMS).as_chunks().0.to_vec(),
        gamma: noise(4, ATOMS),
        gamma_nbr: noise(5, ATOMS),
        features: noise(number as u64, ATOMS * FEATURES),
    });
    CandidateRecord {
        block,
        fate: if number.is_multiple_of(2) { Fate::Accepted } else { Fate::Declined(DeclineReason::Covered) },
        seed_structure: 0,
        selector: grades(),
        original: grades(),
        keep_features: true,
        priority: 10,
    }
}

/// Pseudo-random numbers (SplitMix64) in [0, 1).
fn noise(rng_seed: u64, count: usize) -> Vec<f64> {
    let mut state = rng_seed.wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let mut next = || {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    };
    (0..count).map(|_| next()).collect()
}
