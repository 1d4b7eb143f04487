//! A reading from where the last one ended says the same as one of all labels, whatever happened between.

use std::path::Path;

use atoms::{Cell, Structure};
use serde_json::json;
use store::{
    AtomGrades, CampaignRecord, CandidateRecord, Commit, Decision, Fate, JobState, Label, LabelValue, Lease,
    LowerStateRule, OnLowerState, Protocol, RelabelRequest, SeedStructure, Store, WalkRecord,
};
use wire::messages::WalkProgress;
use wire::{CampaignId, Candidate, CandidateBlock, CandidateId, ContentHash, Origin, WalkConditions, WalkId};

use super::super::learning::ArrivedLabels;
use super::super::{CalibrationReader, CalibrationState, read};

const CAMPAIGN: CampaignId = CampaignId([5; 16]);
const PROTOCOL: ContentHash = ContentHash([3; 32]);
/// Version of the potential of each walk.
const VERSIONS: [u32; 3] = [0, 0, 1];
/// Number of different structures.
const STRUCTURES: u64 = 40;

/// Random numbers (SplitMix64).
struct Draws(u64);

impl Draws {
    fn below(&mut self, number: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % number
    }
}

fn structure(number: u64) -> Structure {
    Structure {
        species: ["Al", "Ni"].map(|symbol| symbol.parse().unwrap()).to_vec(),
        positions: vec![[0.0; 3], [2.0 + 0.01 * number as f64, 0.0, 0.0]],
        cell: Cell::orthorhombic(9.0, 9.0, 9.0),
        periodic: [true; 3],
    }
}

/// A campaign whose walks find structures again that others have found.
struct RandomCampaign {
    store: Store,
    draws: Draws,
    step: u64,
    leases: Vec<Lease>,
}

impl RandomCampaign {
    async fn begin(directory: &Path, seed: u64) -> Self {
        let campaign = CampaignRecord {
            id: CAMPAIGN,
            program_version: "0".into(),
            mode: "live".into(),
            configuration: String::new(),
            resolved_configuration: "{}".into(),
            configuration_in_force: "{}".into(),
        };
        let seeds = [SeedStructure {
            index: 0,
            name: "pair".into(),
            source: "pairs.extxyz".into(),
            structure: structure(0),
        }];
        let store = Store::create(directory, &campaign, &seeds, 0).await.unwrap().with_caller_clock();
        let protocol = Protocol { hash: PROTOCOL, name: "dft".into(), settings: json!({}) };
        store.add_protocol(&protocol, 0).await.unwrap();
        let rule = LowerStateRule { on_lower_state: OnLowerState::Supersede, ..LowerStateRule::default() };
        store.set_lower_state_rule(&rule).await.unwrap();
        let campaign = Self { store, draws: Draws(seed), step: 0, leases: Vec::new() };
        for (number, version) in (0..).zip(VERSIONS) {
            campaign.begin_walk(number, version).await;
        }
        campaign
    }

    async fn begin_walk(&self, number: u32, version: u32) {
        let walk = WalkRecord {
            walk: WalkId(number),
            origin: Origin::Biased,
            partner: None,
            seed_structure: 0,
            conditions: WalkConditions { version, ..WalkConditions::default() },
            state: "running".into(),
            reason: String::new(),
            assignments: 0,
            accepted: 0,
            progress: WalkProgress::default(),
            selector_state: "{}".into(),
            checkpoint: None,
        };
        self.store.commit(&Commit { walks: vec![walk], ..Commit::default() }).await.unwrap();
    }

    /// A walk finds any structure.
    async fn find_any(&mut self) {
        let (walk, number) = (self.draws.below(3) as u32, self.draws.below(STRUCTURES));
        self.find(walk, number).await;
    }

    /// A walk finds a structure, which another one may have found before.
    async fn find(&mut self, walk: u32, number: u64) {
        self.step += 1;
        let structure = structure(number);
        let content = ContentHash::from_structure(&structure);
        let id = CandidateId { campaign: CAMPAIGN, walk: WalkId(walk), segment: 0, step: self.step, content };
        let grades: Vec<f64> = vec![0.05 * self.draws.below(60) as f64, 0.6];
        let block = CandidateBlock::encode(&Candidate {
            id,
            origin: Origin::Biased,
            mixture_version: 0,
            temperature: 300.0,
            relative_volume: 1.0,
            energy: -1.0,
            virial: [[0.0; 3]; 3],
            structure,
            forces: vec![[0.0; 3]; 2],
            gamma: grades.clone(),
            gamma_nbr: grades.clone(),
            features: vec![0.5; 4],
        });
        let original = AtomGrades { gamma: grades.clone(), gamma_nbr: grades };
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
            kind: "accepted",
            walk: Some(WalkId(walk)),
            candidate: Some(id),
            mixture_version: self.step,
            detail: json!({}),
        };
        let commit = Commit { decisions: vec![decision], candidates: vec![record], ..Commit::default() };
        self.store.commit(&commit).await.unwrap();
    }

    /// A walk finds a structure, which gets its label. Returns the candidate's name.
    async fn find_labelled(&mut self, walk: u32, number: u64) -> String {
        self.find(walk, number).await;
        let lease = self.store.lease(PROTOCOL, "a", 0, 9).await.unwrap().unwrap();
        let forces = vec![[0.1, 0.0, 0.0]; 2];
        let label = Label { energy: -1.0, forces, stress: None, details: Default::default() };
        self.store.complete(&lease, &label, 1).await.unwrap();
        lease.candidate
    }

    /// Delivers the label of a lease; another labeller may have delivered one before.
    async fn label(&mut self) {
        if self.draws.below(3) > 0 || self.leases.is_empty() {
            self.leases.extend(self.store.lease(PROTOCOL, "a", 0, 9).await.unwrap());
        }
        if self.draws.below(9) == 0 {
            self.store.release_all("a", 1).await.unwrap();
        }
        if self.leases.is_empty() || self.draws.below(9) == 0 {
            return;
        }
        let place = self.draws.below(self.leases.len() as u64) as usize;
        let lease = self.leases.swap_remove(place);
        let force = 0.1 * self.draws.below(20) as f64;
        let energy = -0.01 * self.draws.below(9) as f64;
        let forces = vec![[force, 0.0, 0.0], [0.0, 2.0 * force, 0.0]];
        let label = Label { energy, forces, stress: None, details: Default::default() };
        self.store.complete(&lease, &label, 2).await.unwrap();
    }

    /// Changes the past: labels are excluded and included again, made again, and their jobs dropped and taken back.
    async fn change(&mut self) {
        let jobs = self.store.queue_list(None, 99, 0).await.unwrap();
        if jobs.is_empty() {
            return;
        }
        let job = &jobs[self.draws.below(jobs.len() as u64) as usize];
        let name = job.candidate.clone();
        match (self.draws.below(3), job.state) {
            (0, JobState::Labelled) => drop(self.store.exclude(&[name], "doubtful", 3).await),
            (1, JobState::Labelled) => drop(self.store.include(&[name], 3).await),
            (_, JobState::Labelled) => {
                let number = self.draws.below(STRUCTURES);
                let structures = [ContentHash::from_structure(&structure(number))];
                let request = RelabelRequest {
                    structures: &structures,
                    include_current: true,
                    reason: "doubtful",
                    protocol: None,
                };
                self.store.relabel(&request, 3).await.unwrap();
            }
            (0, JobState::Queued | JobState::Leased) => drop(self.store.drop_job(&name, 3).await.unwrap()),
            (_, JobState::Queued) => {
                let value = LabelValue { job: job.job, value: 1.0, factors: json!({}) };
                self.store.set_label_values(&[value]).await.unwrap();
            }
            (_, JobState::Dropped) => drop(self.store.retry_job(&name, 3).await.unwrap()),
            _ => {}
        }
    }

    /// Reads what is new and everything, and compares. Returns the number of rows of the former.
    async fn compare(&self, reader: &mut CalibrationReader) -> u64 {
        let rows = reader.read(&self.store, PROTOCOL).await.unwrap();
        for version in [0, 1, 2] {
            let all = read(&self.store, PROTOCOL, version).await.unwrap();
            let kept = reader.of_version(version).cloned().unwrap_or(CalibrationState::new(version));
            assert_eq!(format!("{kept:?}"), format!("{all:?}"), "version {version}");
        }
        rows
    }
}

#[tokio::test]
async fn a_reading_of_what_is_new_says_the_same_as_one_of_all() {
    let (mut labelled, mut by_value) = (0, 0);
    for seed in 0..6 {
        let directory = tempfile::tempdir().unwrap();
        let mut campaign = RandomCampaign::begin(directory.path(), seed).await;
        let mut reader = CalibrationReader::default();
        for _ in 0..90 {
            match campaign.draws.below(10) {
                0..4 => campaign.find_any().await,
                4..8 => campaign.label().await,
                8 => campaign.change().await,
                _ => drop(campaign.compare(&mut reader).await),
            }
        }
        campaign.compare(&mut reader).await;
        assert_eq!(campaign.compare(&mut reader).await, 0, "nothing is new");
        let state = reader.of_version(0).unwrap();
        labelled += state.structures();
        by_value += state.by_value.structures();
    }
    assert!(labelled > 40 && by_value > 0 && by_value < labelled, "{labelled} {by_value}");
}

#[tokio::test]
async fn a_reading_costs_what_is_new() {
    let directory = tempfile::tempdir().unwrap();
    let mut campaign = RandomCampaign::begin(directory.path(), 7).await;
    let mut reader = CalibrationReader::default();
    let mut names = Vec::new();
    for number in 0..8 {
        names.push(campaign.find_labelled(0, number).await);
        assert_eq!(campaign.compare(&mut reader).await, 1);
    }
    campaign.store.exclude(&names[..1], "doubtful", 2).await.unwrap();
    assert_eq!(campaign.compare(&mut reader).await, 7, "one of the labels before is gone");
    campaign.find(2, 3).await;
    assert_eq!(
        campaign.compare(&mut reader).await,
        8,
        "a walk of another version has found one of the structures"
    );
}

/// While labels are read, a walk of a new version begins and finds a structure that has its label.
#[tokio::test]
async fn a_label_counts_for_walks_that_begin_during_the_reading() {
    let directory = tempfile::tempdir().unwrap();
    let mut campaign = RandomCampaign::begin(directory.path(), 8).await;
    let (store, content) = (campaign.store.clone(), ContentHash::from_structure(&structure(0)));
    campaign.find_labelled(2, 0).await;
    let mut readings = [1, 2].map(|version| ArrivedLabels::new(&store, PROTOCOL, version));
    assert_eq!(readings[0].next().await.unwrap().unwrap().content, content);
    assert!(readings[1].next().await.unwrap().is_none());
    campaign.begin_walk(3, 2).await;
    campaign.find(3, 0).await;
    assert!(readings[0].next().await.unwrap().is_none(), "the walk has another version");
    assert_eq!(readings[1].next().await.unwrap().unwrap().content, content);
}
