//! A cluster in a box: a whole campaign in one thread, in virtual time, with faults from one random seed.
//!
//! Real are the selector, the core of the reactor, the protocol of walkers at both ends, the supervisor, and the store with
//! all of its SQL. Stand-ins are at the edges: links, processes, clocks, the layer of faults before the store, walks,
//! calculations, and labellers, which follow the rules of `workers::labeller`. docs/simulation.md says more.
//!
//! `CALMWALK_SEEDS=10000` simulates so many seeds, `CALMWALK_SEEDS=5000..10000` the second half of them, `CALMWALK_SEED=17` one seed, with its
//! story. `CALMWALK_BUG=TornMixture` looks for one planted bug only.

mod agent;
mod calculation;
mod dealing;
mod disturbance;
mod event;
mod fault;
mod faulty_store;
mod invariants;
mod labeller;
mod ladder;
mod link;
mod person;
mod planted;
mod random;
mod reactor_shell;
mod refit;
mod refitter;
mod run;
mod scenario;
mod shrink;
mod slurm;
mod supervision;
mod versions;
mod walker;
mod world;

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;
use std::sync::{LazyLock, Mutex};

use store::{CampaignRecord, Protocol, SeedStructure, Store};
use tempfile::TempDir;

use self::fault::{PlannedFault, plan};
use self::planted::PlantedBug;
use self::scenario::{AGENT_SEEDS, CUSTOM_SEEDS, REFIT_SEEDS, SEED_STRUCTURES, SLURM_SEEDS, Scenario};
use self::world::{Outcome, World};
use crate::common::{CAMPAIGN, seed_structure};

/// Number of seeds that the tests simulate.
const SEEDS: u64 = 64;
/// The same with agents.
const SEEDS_WITH_AGENTS: u64 = 24;
/// The same with refits.
const SEEDS_WITH_REFITS: u64 = 8;
/// The same with Slurm jobs.
const SEEDS_WITH_SLURM: u64 = 12;
/// The same with jobs of PBS or LSF.
const SEEDS_WITH_CUSTOM: u64 = 8;
/// Seeds that once broke an invariant, and those that find errors which the program once had; docs/simulation.md names them.
const ONCE_BROKEN: [u64; 5] = [8_844, REFIT_SEEDS + 35, SLURM_SEEDS + 8, SLURM_SEEDS + 18, CUSTOM_SEEDS + 9];
/// A planted bug must be found within this number of seeds.
const SEEDS_TO_FIND: u64 = 1_000;

/// A directory in memory, if the system has one: nothing is to be kept.
fn directory() -> TempDir {
    let memory = Path::new("/dev/shm");
    if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() }.unwrap()
}

/// The database of a new campaign, with which each simulation begins.
static NEW_CAMPAIGN: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let directory = directory();
    let campaign = CampaignRecord {
        id: CAMPAIGN,
        program_version: "0.1.0".into(),
        mode: "live".into(),
        configuration: String::new(),
        resolved_configuration: "{}".into(),
        configuration_in_force: "{}".into(),
    };
    let seeds: Vec<_> = (0..SEED_STRUCTURES)
        .map(|number| SeedStructure {
            index: number as u32,
            name: seed_structure(number).name,
            source: "seeds.extxyz".into(),
            structure: seed_structure(number).structure,
        })
        .collect();
    let protocol =
        Protocol { hash: labeller::PROTOCOL, name: "reference".into(), settings: serde_json::json!({}) };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let store = Store::create(directory.path(), &campaign, &seeds, 0).await.unwrap();
        store.add_protocol(&protocol, 0).await.unwrap();
        store.close().await;
    });
    std::fs::read(directory.path().join(store::DATABASE)).unwrap()
});

/// The decision log of the undisturbed run of each reproducible scenario.
static UNDISTURBED: Mutex<BTreeMap<u64, String>> = Mutex::new(BTreeMap::new());

/// Simulates a campaign with these faults.
fn simulate(seed: u64, faults: &[PlannedFault], bug: Option<PlantedBug>) -> Outcome {
    let directory = directory();
    let database = directory.path().join(store::DATABASE);
    std::fs::write(&database, NEW_CAMPAIGN.as_slice()).unwrap();
    let mut outcome = World::new(seed, faults.to_vec(), bug, directory.path()).run();
    let scenario = Scenario::of(seed);
    if outcome.violation.is_none() && scenario.is_reproducible() && !(bug.is_none() && faults.is_empty()) {
        let undisturbed = undisturbed_log(&scenario);
        if outcome.log != undisturbed {
            let line = undisturbed.lines().zip(outcome.log.lines()).position(|(a, b)| a != b);
            outcome.violation = Some(format!(
                "the decision log is not that of the undisturbed run: {} and {} lines, the first difference in line {line:?}",
                outcome.log.lines().count(),
                undisturbed.lines().count()
            ));
        }
    }
    outcome
}

fn undisturbed_log(scenario: &Scenario) -> String {
    if let Some(log) = UNDISTURBED.lock().unwrap().get(&scenario.number) {
        return log.clone();
    }
    let outcome = simulate(scenario.number, &[], None);
    assert_eq!(outcome.violation, None, "{}", outcome.story.join("\n"));
    UNDISTURBED.lock().unwrap().insert(scenario.number, outcome.log.clone());
    outcome.log
}

/// The invariant that a seed breaks with this bug, if it breaks one.
fn broken_by(seed: u64, bug: PlantedBug) -> Option<String> {
    simulate(seed, &plan(seed, &Scenario::of(seed)), Some(bug)).violation
}

/// Simulates a seed; if it breaks an invariant, shrinks its faults and tells the story.
fn check(seed: u64) -> Outcome {
    let faults = plan(seed, &Scenario::of(seed));
    let outcome = simulate(seed, &faults, None);
    if outcome.violation.is_some() {
        panic!("{}", shrink::story_of_failure(seed, &faults, None));
    }
    outcome
}

/// What stands in `CALMWALK_SEEDS`, or as many as by default, counted from the first of their kind.
fn seeds(first: u64, default: u64) -> Range<u64> {
    let number = |text: &str| text.parse::<u64>().expect("a number in CALMWALK_SEEDS");
    let (begin, end) = match std::env::var("CALMWALK_SEEDS") {
        Ok(text) => text.split_once("..").map_or_else(|| (0, number(&text)), |(a, b)| (number(a), number(b))),
        Err(_) => (0, default),
    };
    first + begin..first + end
}

#[test]
fn no_seed_breaks_an_invariant() {
    if let Ok(seed) = std::env::var("CALMWALK_SEED") {
        let outcome = check(seed.parse().expect("a number in CALMWALK_SEED"));
        println!("{}", outcome.story.join("\n"));
        return;
    }
    check_seeds(seeds(0, SEEDS));
}

/// The same with agents on other hosts.
#[test]
fn no_seed_with_agents_breaks_an_invariant() {
    check_seeds(seeds(AGENT_SEEDS, SEEDS_WITH_AGENTS));
}

/// The same with refits of the potential.
#[test]
fn no_seed_with_refits_breaks_an_invariant() {
    check_seeds(seeds(REFIT_SEEDS, SEEDS_WITH_REFITS));
}

/// The same with calculations as Slurm jobs, and with jobs of different difficulty.
#[test]
fn no_seed_with_slurm_breaks_an_invariant() {
    check_seeds(seeds(SLURM_SEEDS, SEEDS_WITH_SLURM));
}

/// The same with jobs of PBS or LSF.
#[test]
fn no_seed_with_another_batch_system_breaks_an_invariant() {
    check_seeds(seeds(CUSTOM_SEEDS, SEEDS_WITH_CUSTOM));
}

/// Whatever was mended stays so.
#[test]
fn no_seed_breaks_an_invariant_again() {
    check_seeds(ONCE_BROKEN);
}

fn check_seeds(seeds: impl IntoIterator<Item = u64>) {
    let (mut events, mut time, mut number) = (0, 0, 0);
    for seed in seeds {
        let outcome = check(seed);
        number += 1;
        events += outcome.events;
        time += outcome.ended;
    }
    println!("{number} seeds, {events} events, {} h of virtual time", time / 3_600_000);
}

#[test]
fn a_seed_determines_every_event() {
    let seeds = [3, 4, 10, REFIT_SEEDS + 3];
    for seed in seeds {
        let faults = plan(seed, &Scenario::of(seed));
        let [first, second] = [(); 2].map(|()| simulate(seed, &faults, None));
        assert_eq!(first.story, second.story);
        assert_eq!((first.hash, first.events, first.ended), (second.hash, second.events, second.ended));
    }
    let hashes: std::collections::BTreeSet<u64> =
        seeds.map(|seed| simulate(seed, &plan(seed, &Scenario::of(seed)), None).hash).into();
    assert_eq!(hashes.len(), seeds.len());
}

/// Every planted bug is found. Without `CALMWALK_SEEDS`, the search begins with the seed that found it last.
#[test]
fn planted_bugs_are_found() {
    let all = std::env::var_os("CALMWALK_SEEDS").is_some();
    let only = std::env::var("CALMWALK_BUG").ok();
    let mut missed = Vec::new();
    for bug in
        PlantedBug::ALL.into_iter().filter(|bug| only.as_ref().is_none_or(|only| *only == format!("{bug:?}")))
    {
        let first = (!all).then(|| bug.found_by());
        let seeds = first.into_iter().chain(bug.first_seed()..bug.first_seed() + SEEDS_TO_FIND);
        let found = { seeds }.find_map(|seed| Some((seed, broken_by(seed, bug)?)));
        match found {
            Some((seed, _)) if only.is_some() => {
                println!("{}", shrink::story_of_failure(seed, &plan(seed, &Scenario::of(seed)), Some(bug)));
            }
            Some((seed, broken)) => println!("{bug:?}: seed {seed}: {broken}"),
            None => missed.push(bug),
        }
    }
    assert!(missed.is_empty(), "{missed:?}");
}

/// The story of a failure names the faults that it needs, and no others.
#[test]
fn failures_are_shrunk_to_a_story() {
    let bug = PlantedBug::CommitRepeated;
    let seeds = [bug.found_by()].into_iter().chain(0..SEEDS_TO_FIND);
    let seed = { seeds }.find(|seed| broken_by(*seed, bug).is_some()).unwrap();
    let faults = plan(seed, &Scenario::of(seed));
    let story = shrink::story_of_failure(seed, &faults, Some(bug));
    let left = story.lines().filter(|line| line.starts_with("fault at ")).count();
    assert!((1..faults.len()).contains(&left), "{story}");
    assert!(story.contains("will be lost after its COMMIT") && story.contains("BROKEN: "), "{story}");
}
