//! A small campaign for tests.
#![allow(dead_code, unused_imports, reason = "each test file uses its part")]

mod former_words;
mod test_database;

use atoms::{Cell, Structure};
use serde_json::json;
use store::{
    AtomGrades, CampaignRecord, CandidateRecord, Commit, Decision, Fate, Label, Location, Protocol,
    SeedStructure, Store, WalkRecord,
};
use wire::messages::WalkProgress;
use wire::{CampaignId, Candidate, CandidateBlock, CandidateId, ContentHash, Origin, WalkConditions, WalkId};

pub use former_words::{
    TO_VERSION_15, TO_VERSION_16, TO_VERSION_17, TO_VERSION_19, TO_VERSION_20, check_present_words,
    write_former_words,
};
pub use test_database::{TestDatabase, server};

pub const CAMPAIGN: CampaignId = CampaignId([0x9f; 16]);
pub const ATOMS: usize = 2;

pub fn campaign() -> CampaignRecord {
    CampaignRecord {
        id: CAMPAIGN,
        program_version: "0.1.0".into(),
        mode: "reproducible".into(),
        configuration: "mode = \"reproducible\"\n".into(),
        resolved_configuration: "{}".into(),
        configuration_in_force: "{}".into(),
    }
}

pub fn structure(shift: f64) -> Structure {
    let silicon = "Si".parse().unwrap();
    Structure {
        species: vec![silicon; ATOMS],
        positions: vec![[shift, 0.0, 0.0], [1.3575, 1.3575, 1.3575]],
        cell: Cell::orthorhombic(5.43, 5.43, 5.43),
        periodic: [true; 3],
    }
}

pub fn protocol(name: &str) -> Protocol {
    let mut hash = [0; 32];
    hash[..name.len()].copy_from_slice(name.as_bytes());
    Protocol { hash: ContentHash(hash), name: name.into(), settings: json!({ "code": name }) }
}

/// A campaign in a directory, with one seed structure and the protocol "dft" in force.
pub async fn create(directory: &std::path::Path) -> Store {
    create_at(directory.into()).await
}

pub async fn create_at(location: Location) -> Store {
    let seed_structure = SeedStructure {
        index: 0,
        name: "diamond".into(),
        source: "seeds.extxyz".into(),
        structure: structure(0.0),
    };
    let store = Store::create(location, &campaign(), &[seed_structure], 0).await.unwrap();
    store.add_protocol(&protocol("dft"), 0).await.unwrap();
    store
}

pub fn label(energy: f64) -> Label {
    Label {
        energy,
        forces: vec![[0.5 * energy, -0.1, 0.0]; ATOMS],
        stress: Some([[energy, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]),
        details: Default::default(),
    }
}

/// The candidate of a walk at a step; both determine its structure.
pub fn candidate(walk: u32, step: u64, origin: Origin, fate: Fate) -> CandidateRecord {
    let structure = structure(f64::from(walk) + 1e-6 * step as f64);
    let content = ContentHash::from_structure(&structure);
    let block = CandidateBlock::encode(&Candidate {
        id: CandidateId { campaign: CAMPAIGN, walk: WalkId(walk), segment: 0, step, content },
        origin,
        mixture_version: 3,
        temperature: 300.25,
        relative_volume: 1.01,
        energy: -8.5,
        virial: [[1.0, 2.0, 3.0], [2.0, 4.0, 5.0], [3.0, 5.0, 6.0]],
        structure,
        forces: vec![[0.1, 0.2, 0.3]; ATOMS],
        gamma: vec![1.4, 0.9],
        gamma_nbr: vec![1.1, 1.0],
        features: (0..3 * ATOMS).map(|k| (k as f64).sqrt()).collect(),
    });
    let grades =
        |shift: f64| AtomGrades { gamma: vec![1.3 + shift, 0.8], gamma_nbr: vec![1.05, 1.0 + shift] };
    CandidateRecord {
        block,
        fate,
        seed_structure: 0,
        selector: grades(0.0),
        original: grades(0.1),
        keep_features: true,
        priority: if origin == Origin::Biased { 10 } else { 0 },
    }
}

pub fn name_of(candidate: &CandidateRecord) -> String {
    candidate.block.view().id().to_string()
}

/// A commit of these candidates with a decision on each.
pub fn commit_of(candidates: Vec<CandidateRecord>) -> Commit {
    let decisions = candidates.iter().map(|candidate| {
        let id = candidate.block.view().id();
        let kind = match (candidate.block.view().origin(), candidate.fate) {
            (Origin::Control, _) => "control",
            (_, Fate::Accepted) => "accepted",
            (_, Fate::Declined(_)) => "declined",
        };
        Decision {
            round: 1,
            kind,
            walk: Some(id.walk),
            candidate: Some(id),
            mixture_version: id.step,
            detail: json!({ "gamma": 1.25, "text": "a \"quoted\" line\n" }),
        }
    });
    Commit { decisions: decisions.collect(), candidates, ..Commit::default() }
}

pub fn walk(walk: u32, assignments: u64) -> WalkRecord {
    WalkRecord {
        walk: WalkId(walk),
        origin: Origin::Biased,
        partner: None,
        seed_structure: 0,
        conditions: WalkConditions::default(),
        state: "running".into(),
        reason: String::new(),
        assignments,
        accepted: 1,
        progress: WalkProgress {
            step: 100 * assignments,
            tau: 0.5,
            temperature: 310.0,
            rejected: 2,
            ..WalkProgress::default()
        },
        selector_state: "{}".into(),
        checkpoint: Some(assignments.to_le_bytes().to_vec()),
    }
}

/// Commits `number` accepted candidates of walk 0 and returns their names.
pub async fn accept(store: &Store, number: u64) -> Vec<String> {
    accept_from(store, 1, number).await
}

/// The same from a given step.
pub async fn accept_from(store: &Store, first: u64, number: u64) -> Vec<String> {
    let mut names = Vec::new();
    for step in first..first + number {
        let record = candidate(0, step, Origin::Biased, Fate::Accepted);
        names.push(name_of(&record));
        store.commit(&commit_of(vec![record])).await.unwrap();
    }
    names
}
