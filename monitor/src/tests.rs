//! Small campaigns for the tests of this package, in which walks find what a test says.

use std::path::Path;

use atoms::{Cell, Structure};
use serde_json::json;
use store::{
    AtomGrades, CampaignRecord, CandidateRecord, Commit, Decision, Fate, Label, Protocol, SeedStructure,
    Store, WalkRecord,
};
use wire::messages::WalkProgress;
use wire::{CampaignId, Candidate, CandidateBlock, CandidateId, ContentHash, Origin, WalkConditions, WalkId};

const CAMPAIGN: CampaignId = CampaignId([5; 16]);
/// The protocol in force.
pub const PROTOCOL: ContentHash = ContentHash([3; 32]);

/// A structure of one atom that a walk finds.
#[derive(Clone, Copy, Debug)]
pub struct FoundStructure {
    /// Which structure.
    pub number: u64,
    pub walk: u32,
    pub origin: Origin,
    pub segment: u32,
    pub step: u64,
    /// γ and γ_nbr.
    pub gamma: f64,
    pub relative_volume: f64,
}

impl FoundStructure {
    /// Found by the biased walk 0, at the step with its number.
    pub fn new(number: u64) -> Self {
        let (gamma, relative_volume) = (2.0, 1.0);
        Self { number, walk: 0, origin: Origin::Biased, segment: 0, step: number, gamma, relative_volume }
    }
}

/// A campaign with these walks and the protocol in force.
pub async fn begin(directory: &Path, walks: Vec<WalkRecord>) -> Store {
    let campaign = CampaignRecord {
        id: CAMPAIGN,
        program_version: "0".into(),
        mode: "live".into(),
        configuration: String::new(),
        resolved_configuration: "{}".into(),
        configuration_in_force: "{}".into(),
    };
    let seed =
        SeedStructure { index: 0, name: "atom".into(), source: "a.extxyz".into(), structure: structure(0) };
    let store = Store::create(directory, &campaign, &[seed], 0).await.unwrap();
    let protocol = Protocol { hash: PROTOCOL, name: "dft".into(), settings: json!({}) };
    store.add_protocol(&protocol, 0).await.unwrap();
    store.commit(&Commit { walks, ..Commit::default() }).await.unwrap();
    store
}

/// A biased walk from the only seed structure.
pub fn biased(number: u32) -> WalkRecord {
    WalkRecord {
        walk: WalkId(number),
        origin: Origin::Biased,
        partner: None,
        seed_structure: 0,
        conditions: WalkConditions::default(),
        state: "running".into(),
        reason: String::new(),
        assignments: 0,
        accepted: 0,
        progress: WalkProgress::default(),
        selector_state: "{}".into(),
        checkpoint: None,
    }
}

fn structure(number: u64) -> Structure {
    Structure {
        species: vec!["Al".parse().unwrap()],
        positions: vec![[0.01 * number as f64, 0.0, 0.0]],
        cell: Cell::orthorhombic(9.0, 9.0, 9.0),
        periodic: [true; 3],
    }
}

/// A walk finds a structure, which waits for its label.
pub async fn find(store: &Store, found: FoundStructure) {
    let FoundStructure { number, walk, origin, segment, step, gamma, relative_volume } = found;
    let (structure, walk) = (structure(number), WalkId(walk));
    let content = ContentHash::from_structure(&structure);
    let id = CandidateId { campaign: CAMPAIGN, walk, segment, step, content };
    let original = AtomGrades { gamma: vec![gamma], gamma_nbr: vec![gamma] };
    let block = CandidateBlock::encode(&Candidate {
        id,
        origin,
        mixture_version: 0,
        temperature: 300.0,
        relative_volume,
        energy: -1.0,
        virial: [[0.0; 3]; 3],
        structure,
        forces: vec![[0.0; 3]],
        gamma: vec![gamma],
        gamma_nbr: vec![gamma],
        features: vec![0.5; 2],
    });
    let record = CandidateRecord {
        block,
        fate: Fate::Accepted,
        seed_structure: 0,
        selector: original.clone(),
        original,
        keep_features: false,
        priority: 0,
    };
    let decision = Decision {
        round: 1,
        kind: if origin == Origin::Biased { "accepted" } else { "control" },
        walk: Some(walk),
        candidate: Some(id),
        mixture_version: step,
        detail: json!({}),
    };
    let commit = Commit { decisions: vec![decision], candidates: vec![record], ..Commit::default() };
    store.commit(&commit).await.unwrap();
}

/// The next label is made, or fails for good.
pub async fn finish(store: &Store, completes: bool) {
    let lease = store.lease(PROTOCOL, "a", 0, 9).await.unwrap().unwrap();
    let stress = Some([[0.002, 0.0, 0.0], [0.0, 0.002, 0.0], [0.0, 0.0, 0.002]]);
    let label = Label { energy: -1.0, forces: vec![[0.3, 0.0, 0.0]], stress, details: Default::default() };
    match completes {
        true => drop(store.complete(&lease, &label, 1).await.unwrap()),
        false => drop(store.fail(&lease, "crashed", "", 1, 1).await.unwrap()),
    }
}
