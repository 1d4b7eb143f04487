//! Writes a campaign of five elements with 2000 finished labels, to look at the report and at the dashboard:
//!
//! `cargo run -p store --example five_elements -- DIR`, then `calmwalk report DIR -o REPORT` and `calmwalk dashboard DIR`.
//!
//! Force errors rise with the grade and differ between elements, labels fail more often the larger the cell is, and the last quarter of
//! the labels comes by value.

use std::error::Error;
use std::path::Path;

use atoms::{Cell, Species, Structure};
use serde_json::json;
use store::{
    AtomGrades, CalculationRecord, CampaignRecord, CandidateRecord, Commit, Decision, Fate, Label,
    LabelValue, Lease, Protocol, SeedStructure, Store, WalkRecord,
};
use wire::messages::{DeclineReason, WalkProgress};
use wire::{CampaignId, Candidate, CandidateBlock, CandidateId, ContentHash, Origin, WalkConditions, WalkId};

const CAMPAIGN: CampaignId = CampaignId([0x5e; 16]);
const PROTOCOL: ContentHash = ContentHash([0xd7; 32]);
const ELEMENTS: [&str; 5] = ["Ti", "Zr", "Nb", "Hf", "Ta"];
/// Spread of the force errors of each element, eV/Å.
const ERRORS: [f64; 5] = [0.05, 0.08, 0.12, 0.06, 0.2];
/// Energy of an atom by the labels less that by the potential, eV.
const OFFSETS: [f64; 5] = [-1.2, 0.4, 0.1, 2.2, -0.3];
const ATOMS: usize = 20;
const FEATURES: usize = 6;
const SEED_STRUCTURES: u32 = 15;
/// Biased walks; each has a control.
const WALKS: u32 = 50;
const CANDIDATES_OF_A_WALK: u64 = 21;
const FINISHED_LABELS: usize = 2000;
/// Milliseconds between two labels.
const INTERVAL: i64 = 40_000;

type AnyResult<T> = Result<T, Box<dyn Error>>;

/// Random numbers (SplitMix64).
struct Draws(u64);

impl Draws {
    /// Between 0 and 1.
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Normal (Box and Muller).
    fn normal(&mut self) -> f64 {
        (-2.0 * (1.0 - self.uniform()).ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }

    fn vector(&mut self, length: f64) -> [f64; 3] {
        [(); 3].map(|()| length / 3.0_f64.sqrt() * self.normal())
    }
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> AnyResult<()> {
    let directory = std::env::args().nth(1).ok_or("expected the directory of a new campaign")?;
    std::fs::create_dir_all(&directory)?;
    let mut draws = Draws(1);
    let store = begin(Path::new(&directory), &mut draws).await?;
    for walk in 0..WALKS {
        let records = (0..CANDIDATES_OF_A_WALK).flat_map(|step| pair(walk, 200 * (step + 1), &mut draws));
        commit(&store, records.collect()).await?;
    }
    for number in 0..FINISHED_LABELS {
        if number == 3 * FINISHED_LABELS / 4 {
            give_values(&store, &mut draws).await?;
        }
        let now = INTERVAL * number as i64;
        let Some(lease) = store.lease(PROTOCOL, "node1-1-1", now, 3600).await? else { break };
        finish(&store, &lease, now, &mut draws).await?;
    }
    Ok(())
}

async fn begin(directory: &Path, draws: &mut Draws) -> AnyResult<Store> {
    let settings = json!({ "walk": { "tau": 0.4, "temperature": 600.0 }, "label": { "order": "value" } });
    let campaign = CampaignRecord {
        id: CAMPAIGN,
        program_version: env!("CARGO_PKG_VERSION").into(),
        mode: "live".into(),
        configuration: String::new(),
        resolved_configuration: settings.to_string(),
        configuration_in_force: settings.to_string(),
    };
    let seed = |index: u32, structure: Structure| SeedStructure {
        index,
        name: format!("{} {index}", ["bcc", "hcp", "liquid"][index as usize % 3]),
        source: "seeds.extxyz".into(),
        structure,
    };
    let seeds: Vec<_> =
        (0..SEED_STRUCTURES).map(|index| seed(index, structure(index, 1.0, 0.0, draws))).collect();
    let store = Store::create(directory, &campaign, &seeds, 0).await?;
    let protocol = Protocol { hash: PROTOCOL, name: "pbe".into(), settings: json!({ "code": "example" }) };
    store.add_protocol(&protocol, 0).await?;
    let walks = (0..2 * WALKS).map(|number| WalkRecord {
        walk: WalkId(number),
        origin: if number < WALKS { Origin::Biased } else { Origin::Control },
        partner: (number >= WALKS).then(|| WalkId(number - WALKS)),
        seed_structure: number % WALKS % SEED_STRUCTURES,
        conditions: WalkConditions { temperature: 600.0, tau: 0.4, ..WalkConditions::default() },
        state: "completed".into(),
        reason: String::new(),
        assignments: 1,
        accepted: CANDIDATES_OF_A_WALK as u32,
        progress: WalkProgress { step: 200 * CANDIDATES_OF_A_WALK, ..WalkProgress::default() },
        selector_state: "{}".into(),
        checkpoint: None,
    });
    store.commit(&Commit { walks: walks.collect(), ..Commit::default() }).await?;
    Ok(store)
}

/// A simple cubic crystal with a random occupation that depends on the seed structure, and displaced atoms.
fn structure(seed: u32, relative_volume: f64, displacement: f64, draws: &mut Draws) -> Structure {
    let edge = 2.9 * relative_volume.cbrt();
    let mut species: Vec<Species> = Vec::with_capacity(ATOMS);
    while species.len() < ATOMS {
        let drawn = draws.uniform() * 5.0;
        let element = if draws.uniform() < 0.4 { seed as usize % 5 } else { drawn as usize % 5 };
        species.extend(ELEMENTS[element].parse::<Species>());
    }
    let site = |atom: usize| [atom % 5, atom / 5 % 2, atom / 10].map(|k| edge * k as f64);
    let positions = (0..ATOMS).map(|atom| {
        let (site, shift) = (site(atom), draws.vector(displacement));
        [0, 1, 2].map(|k| site[k] + shift[k])
    });
    Structure {
        positions: positions.collect(),
        species,
        cell: Cell::orthorhombic(5.0 * edge, 2.0 * edge, 2.0 * edge),
        periodic: [true; 3],
    }
}

/// What a biased walk and its control found at a step. Every tenth biased candidate is declined.
fn pair(walk: u32, step: u64, draws: &mut Draws) -> Vec<CandidateRecord> {
    let covered = Fate::Declined(DeclineReason::Covered);
    let fate = if draws.uniform() < 0.1 { covered } else { Fate::Accepted };
    let biased = candidate(walk, step, Origin::Biased, fate, draws);
    let control = candidate(walk + WALKS, step, Origin::Control, Fate::Accepted, draws);
    vec![biased, control]
}

fn candidate(walk: u32, step: u64, origin: Origin, fate: Fate, draws: &mut Draws) -> CandidateRecord {
    let is_biased = origin == Origin::Biased;
    let seed_structure = walk % WALKS % SEED_STRUCTURES;
    let relative_volume = 0.95 + if is_biased { 0.45 } else { 0.25 } * draws.uniform();
    let structure = structure(seed_structure, relative_volume, 0.3, draws);
    let scale: f64 = if is_biased { 1.1 } else { 0.7 };
    let gamma: Vec<f64> = (0..ATOMS).map(|_| scale * (0.6 * draws.normal()).exp()).collect();
    let mean = gamma.iter().sum::<f64>() / ATOMS as f64;
    let gamma_nbr: Vec<f64> = gamma.iter().map(|gamma| 0.5 * (gamma + mean)).collect();
    let features =
        gamma.iter().flat_map(|gamma| (0..FEATURES).map(move |k| gamma * (k as f64 + gamma).sin()));
    let id = CandidateId {
        campaign: CAMPAIGN,
        walk: WalkId(walk),
        segment: 0,
        step,
        content: ContentHash::from_structure(&structure),
    };
    let block = CandidateBlock::encode(&Candidate {
        id,
        origin,
        mixture_version: 0,
        temperature: if is_biased { 900.0 } else { 600.0 } + 40.0 * draws.normal(),
        relative_volume,
        energy: -6.0 * ATOMS as f64,
        virial: [[0.0; 3]; 3],
        forces: (0..ATOMS).map(|_| draws.vector(1.0)).collect(),
        gamma: gamma.clone(),
        gamma_nbr: gamma_nbr.clone(),
        features: features.collect(),
        structure,
    });
    let original = AtomGrades { gamma, gamma_nbr };
    CandidateRecord {
        block,
        fate,
        seed_structure,
        selector: original.clone(),
        original,
        keep_features: true,
        priority: if is_biased { 10 } else { 0 },
    }
}

async fn commit(store: &Store, candidates: Vec<CandidateRecord>) -> AnyResult<()> {
    let decision = |record: &CandidateRecord| {
        let view = record.block.view();
        let kind = match (view.origin(), record.fate) {
            (Origin::Control, _) => "control",
            (_, Fate::Accepted) => "accepted",
            _ => "declined",
        };
        let (walk, candidate) = (Some(view.id().walk), Some(view.id()));
        Decision { round: 1, kind, walk, candidate, mixture_version: 0, detail: json!({}) }
    };
    let decisions = candidates.iter().map(decision).collect();
    store.commit(&Commit { decisions, candidates, ..Commit::default() }).await?;
    Ok(())
}

/// Gives every job that waits a value.
async fn give_values(store: &Store, draws: &mut Draws) -> AnyResult<()> {
    let jobs = store.queue_list(Some(store::JobState::Queued), u32::MAX, 0).await?;
    let value =
        |job: store::QueueEntry| LabelValue { job: job.job, value: draws.uniform(), factors: json!({}) };
    store.set_label_values(&jobs.into_iter().map(value).collect::<Vec<_>>()).await?;
    Ok(())
}

/// Ends a lease with a label, or with a failure that is likelier in a large cell.
async fn finish(store: &Store, lease: &Lease, now: i64, draws: &mut Draws) -> AnyResult<()> {
    let structure = &lease.structure;
    let found = store.candidate(&lease.candidate).await?.ok_or("the candidate of a lease is gone")?;
    let view = found.block.view();
    let seconds = 300.0 * (0.2 * draws.normal()).exp();
    let made = CalculationRecord {
        cores: Some(8),
        remedies: None,
        difference: None,
        atoms: Some(ATOMS as u32),
        electrons: Some(10.0 * ATOMS as f64),
        k_points: Some(8),
    };
    store.record_calculation(lease, &format!("example-{}", lease.job), &made).await?;
    store.record_cost(lease, 8.0 * seconds, "").await?;
    let end = now + INTERVAL / 2;
    if draws.uniform() > 1.0 / (1.0 + (20.0 * (view.relative_volume() - 1.35)).exp()) {
        store.fail(lease, "not_converged", "no convergence after 100 steps", 1, end).await?;
        return Ok(());
    }
    let place = |species: &Species| ELEMENTS.iter().position(|name| *name == species.symbol()).unwrap_or(0);
    let mut energy = view.energy();
    let mut forces = Vec::with_capacity(ATOMS);
    for ((species, force), grade) in structure.species.iter().zip(view.forces).zip(&found.original.gamma_nbr)
    {
        let element = place(species);
        energy += OFFSETS[element] + 0.01 * grade * draws.normal();
        let error = draws.vector(ERRORS[element] * grade.powf(1.3));
        forces.push([0, 1, 2].map(|k| force[k] + error[k]));
    }
    let stress = [(); 3].map(|()| draws.vector(0.003));
    let symmetric = [0, 1, 2].map(|i| [0, 1, 2].map(|j| 0.5 * (stress[i][j] + stress[j][i])));
    let label = Label { energy, forces, stress: Some(symmetric), details: Default::default() };
    store.complete(lease, &label, end).await?;
    Ok(())
}
