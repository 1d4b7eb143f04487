//! Recorded candidates: hot and strained aluminium of 108 atoms, with the features of a real model.

use std::path::Path;
use std::sync::Arc;
use std::thread;

use atoms::{Cell, Evaluation, Matrix3, NeighbourList, Structure, cell, read_extxyz};
use calm::rules::{MaximumGrade, Positive};
use calm::{Artifact, CollectionRule, Mixture};
use orchestrator::grader::Grader;
use orchestrator::selector::TrainingFrames;
use potentials::grace::{Grace, GraceModel, PullBack};
use wire::messages::WalkProgress;
use wire::{CampaignId, Candidate, CandidateBlock, CandidateId, ContentHash, Origin, WalkId};

use crate::random::Random;

/// A model with the mixture of its training frames.
const DATA: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/data/al_eam_1l");
/// Every second training frame is monitored; campaigns thin these frames to as many.
const WATCH_EVERY: usize = 2;
/// Lattice constant of the seed structure, Å, and its repetitions.
const LATTICE_CONSTANT: f64 = 4.05;
const REPETITIONS: usize = 3;

pub const CAMPAIGN: CampaignId = CampaignId([0xbe; 16]);

/// What candidates need of a model.
pub struct Model {
    grace: Arc<GraceModel>,
    pub grader: Grader,
    pub original: Arc<Mixture>,
    pub training: TrainingFrames,
}

/// What to record.
#[derive(Clone, Copy)]
pub struct Plan {
    /// Number of walks that share the candidates.
    pub walks: usize,
    /// Number of states of strain and disorder that the walks visit in sequence.
    pub kinds: usize,
    /// Number of candidates in each state, which differ by a small displacement.
    pub of_kind: usize,
    /// When a walker collects a structure.
    pub collection: CollectionRule,
    /// Minimum distance of the walker's guard, Å.
    pub min_distance: f64,
}

impl Model {
    pub fn load() -> Self {
        let data = Path::new(DATA);
        let grace = Arc::new(GraceModel::load(&data.join("kokkos.npz")).unwrap());
        let original = Arc::new(Artifact::load(data.join("gmm_artifacts.npz")).unwrap().mixture);
        let n = grace.elements().len();
        let cutoffs = (0..n * n).map(|k| grace.pair_cutoff(k / n, k % n)).collect();
        let grader = Grader::new(grace.elements().to_vec(), cutoffs);
        let frames = read_extxyz(&data.join("seed_frames.extxyz")).unwrap();
        let mut evaluator = Evaluator::new(&grace);
        let (mut elements, mut features) = (Vec::new(), Vec::new());
        for frame in frames.iter().step_by(WATCH_EVERY) {
            evaluator.forward(&frame.structure);
            elements.extend(grader.element_indices(&frame.structure).unwrap());
            features.extend_from_slice(evaluator.grace.features());
        }
        let training = TrainingFrames::new(&elements, &features, &original).unwrap();
        Self { grace, grader, original, training }
    }

    /// Blocks of each walk, in the order in which the walk offers them.
    pub fn record(&self, plan: Plan) -> Vec<Vec<CandidateBlock>> {
        let cores = thread::available_parallelism().map_or(1, |cores| cores.get());
        let kinds = (0..plan.kinds).collect::<Vec<_>>();
        let blocks: Vec<CandidateBlock> = thread::scope(|scope| {
            let parts = kinds.chunks(plan.kinds.div_ceil(cores));
            let parts: Vec<_> = parts
                .map(|part| {
                    scope.spawn(move || part.iter().flat_map(|k| self.kind(plan, *k)).collect::<Vec<_>>())
                })
                .collect();
            parts.into_iter().flat_map(|part| part.join().unwrap()).collect()
        });
        let mut walks = vec![Vec::new(); plan.walks];
        for (number, block) in blocks.into_iter().enumerate() {
            walks[number % plan.walks].push(block);
        }
        walks
    }

    /// A candidate that the original mixture covers: the crystal with small displacements.
    #[allow(dead_code, reason = "only the bench of agents needs it")]
    pub fn at_rest(&self, number: u64) -> Candidate {
        let mut structure = crystal();
        displace(&mut structure, LIKENESS, &mut Random::new(number));
        let threshold = Positive::try_from(f64::MIN_POSITIVE).unwrap();
        let any = CollectionRule::MaximumGrade(MaximumGrade { threshold });
        let plan = Plan { walks: 1, kinds: 1, of_kind: 1, collection: any, min_distance: 1.0 };
        let candidate = self.candidate(plan, number, structure, &mut Evaluator::new(&self.grace));
        candidate.expect("any structure is collected")
    }

    /// The candidates of one state. Draws another one if the original mixture covers it, or if atoms are too close.
    fn kind(&self, plan: Plan, kind: usize) -> Vec<CandidateBlock> {
        let mut random = Random::new(kind as u64);
        let mut evaluator = Evaluator::new(&self.grace);
        loop {
            let state = State::draw(&mut random);
            let candidates = (0..plan.of_kind).map(|k| {
                let number = (kind * plan.of_kind + k) as u64;
                let candidate = self.candidate(plan, number, state.structure(&mut random), &mut evaluator)?;
                Some(CandidateBlock::encode(&candidate))
            });
            if let Some(blocks) = candidates.collect() {
                return blocks;
            }
        }
    }

    /// The candidate, if a walker would collect the structure.
    fn candidate(
        &self,
        plan: Plan,
        number: u64,
        structure: Structure,
        evaluator: &mut Evaluator,
    ) -> Option<Candidate> {
        let bonds = self.grader.bonds(&structure).unwrap();
        if bonds.shortest.shortest() < plan.min_distance {
            return None;
        }
        evaluator.forward(&structure);
        let features = evaluator.grace.features().to_vec();
        let grades = bonds.grade(&self.original, &features).unwrap();
        if !plan.collection.is_met(&grades.gamma) {
            return None;
        }
        let energy = evaluator.energy();
        let progress = progress(number / plan.walks as u64);
        Some(Candidate {
            id: CandidateId {
                campaign: CAMPAIGN,
                walk: WalkId((number % plan.walks as u64) as u32),
                segment: progress.segment,
                step: progress.step,
                content: ContentHash::from_structure(&structure),
            },
            origin: Origin::Biased,
            mixture_version: 0,
            temperature: progress.temperature,
            relative_volume: structure.cell.volume() / crystal().cell.volume(),
            energy: energy.atomic_energies.iter().sum(),
            virial: energy.virial,
            structure,
            forces: energy.forces,
            gamma: grades.gamma,
            gamma_nbr: grades.gamma_nbr,
            features,
        })
    }
}

/// State of a walk at its candidate with this number.
pub fn progress(number: u64) -> WalkProgress {
    WalkProgress {
        step: 20 * (number + 1),
        temperature: 600.0,
        relative_volume: 1.0,
        ..WalkProgress::default()
    }
}

/// Face-centred cubic aluminium, 108 atoms.
pub fn crystal() -> Structure {
    const BASIS: [[f64; 3]; 4] = [[0.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]];
    let n = REPETITIONS;
    let corners = (0..n * n * n).map(|k| [k / (n * n), k / n % n, k % n].map(|x| x as f64));
    let positions: Vec<_> = corners
        .flat_map(|corner| BASIS.map(|site| cell::scale(cell::add(corner, site), LATTICE_CONSTANT)))
        .collect();
    let length = LATTICE_CONSTANT * n as f64;
    Structure {
        species: vec!["Al".parse().unwrap(); positions.len()],
        positions,
        cell: Cell::orthorhombic(length, length, length),
        periodic: [true; 3],
    }
}

/// A strained and disordered aluminium structure.
struct State(Structure);

/// Standard deviation of each coordinate among the candidates of a state, Å.
const LIKENESS: f64 = 0.02;

impl State {
    /// Strained by up to 14 %, sheared, and each coordinate displaced by 0.1 to 0.35 Å.
    fn draw(random: &mut Random) -> Self {
        let stretch = 1.0 + 0.14 * random.uniform();
        let [xx, yy, zz, yz, xz, xy] = [(); 6].map(|()| 0.05 * random.normal());
        let deformation: Matrix3 = [[stretch + xx, xy, xz], [xy, stretch + yy, yz], [xz, yz, stretch + zz]];
        let mut structure = crystal();
        structure.cell.0 = structure.cell.0.map(|row| cell::row_times(row, &deformation));
        for position in &mut structure.positions {
            *position = cell::row_times(*position, &deformation);
        }
        displace(&mut structure, 0.1 + 0.25 * random.uniform(), random);
        Self(structure)
    }

    fn structure(&self, random: &mut Random) -> Structure {
        let mut structure = self.0.clone();
        displace(&mut structure, LIKENESS, random);
        structure
    }
}

fn displace(structure: &mut Structure, deviation: f64, random: &mut Random) {
    for position in &mut structure.positions {
        *position = cell::add(*position, [(); 3].map(|()| deviation * random.normal()));
    }
}

/// The model in use.
struct Evaluator {
    grace: Grace,
    neighbours: NeighbourList,
}

impl Evaluator {
    fn new(model: &Arc<GraceModel>) -> Self {
        Self { grace: Grace::new(Arc::clone(model)), neighbours: NeighbourList::new(model.cutoff(), 0.0) }
    }

    fn forward(&mut self, structure: &Structure) {
        self.neighbours.update(structure).unwrap();
        self.grace.forward(structure, &self.neighbours).unwrap();
    }

    fn energy(&mut self) -> Evaluation {
        let mut energy = Evaluation::default();
        self.grace.backward(None, &mut energy, &mut PullBack::default());
        energy
    }
}
