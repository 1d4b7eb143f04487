//! Models and crystals of the benchmark.

use std::hint::black_box;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use atoms::{Cell, Evaluation, NeighbourList, Potential, Structure};
use calm::{Artifact, BatchedGrades, Mixture};
use potentials::grace::{Grace, GraceModel, Instructions, Precision, PullBack, RadialPath, Threads};

/// A model, and how gracemaker obtains an equivalent one.
pub struct Model {
    pub name: &'static str,
    /// Its path in the repository; otherwise under `CALMWALK_PEER_DATA`.
    committed: Option<&'static str>,
    peer_data: &'static str,
    /// Edge of a cubic cell of four atoms, Å.
    edge: f64,
    /// Preset and its arguments as JSON; without a preset there is a checkpoint beside the model's peer data.
    pub preset: Option<(&'static str, &'static str)>,
}

pub const MODELS: [Model; 3] = [
    Model {
        name: "al_eam_1l",
        committed: Some("configs/data/al_eam_1l"),
        peer_data: "models/al_eam_1l",
        edge: 4.05,
        preset: None,
    },
    Model {
        name: "grace1l_paper",
        committed: None,
        peer_data: "grace/grace1l_paper",
        edge: 4.03,
        preset: Some((
            "GRACE_1LAYER_latest",
            r#"{"lmax": 4, "n_rad_base": 8, "n_rad_max": 32, "prod_func_n_max": 64, "n_mlp_dens": 12}"#,
        )),
    },
    Model {
        name: "grace2l_small",
        committed: None,
        peer_data: "grace/grace2l_small",
        edge: 4.03,
        preset: Some((
            "GRACE_2LAYER_latest",
            r#"{"lmax": [4, 3], "n_rad_max": [32, 32], "prod_func_n_max": [32, 32], "n_mlp_dens": 12, "n_rad_base": 8}"#,
        )),
    },
];

impl Model {
    /// The folder of the model, if available.
    pub fn folder(&self) -> Option<PathBuf> {
        match self.committed {
            Some(path) => Some(Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(path)),
            None => self.peer_folder(),
        }
    }

    /// The folder of gracemaker's checkpoint and mixture.
    pub fn peer_folder(&self) -> Option<PathBuf> {
        std::env::var_os("CALMWALK_PEER_DATA").map(|data| Path::new(&data).join(self.peer_data))
    }
}

/// The quantities to compute.
#[derive(Clone, Copy)]
pub enum Call {
    Plain,
    /// With γ but without its gradient.
    Gamma,
    Graded,
}

/// A model and a hot fcc crystal of its elements.
pub struct Case {
    pub structure: Structure,
    grace: Grace,
    neighbours: NeighbourList,
    elements: Vec<usize>,
    mixture: Mixture,
    grades: BatchedGrades,
    pull_back: PullBack,
    out: Evaluation,
}

impl Case {
    pub fn new(model: &Model, cells: usize, precision: Precision) -> Self {
        Self::with_threads(model, cells, precision, Threads::default())
    }

    pub fn with_threads(model: &Model, cells: usize, precision: Precision, threads: Threads) -> Self {
        let folder = model.folder().expect("the model is here");
        let weights = GraceModel::load_in(&folder.join("kokkos.npz"), precision, RadialPath::default())
            .expect("a model");
        let weights = Arc::new(weights);
        let mixture = Artifact::load_export(folder.join("kokkos.npz")).expect("CALM arrays").mixture;
        let structure = crystal(&weights, cells, model.edge);
        let mut neighbours = NeighbourList::new(weights.cutoff(), 0.5);
        neighbours.update(&structure).expect("a crystal");
        let elements = weights.element_indices(&structure.species).expect("elements of the model");
        Self {
            structure,
            grace: Grace::with(weights, Instructions::best(), threads),
            neighbours,
            elements,
            mixture,
            grades: BatchedGrades::default(),
            pull_back: PullBack::default(),
            out: Evaluation::default(),
        }
    }

    /// Runs a call and returns its time in seconds.
    pub fn seconds(&mut self, call: Call) -> f64 {
        let start = Instant::now();
        match call {
            Call::Plain => {
                let Self { structure, grace, neighbours, out, .. } = &mut *self;
                grace.evaluate(structure, neighbours, out).expect("known elements");
            }
            Call::Gamma => self.graded(false),
            Call::Graded => self.graded(true),
        }
        black_box(&self.out);
        start.elapsed().as_secs_f64()
    }

    /// Energy and forces with γ and, on request, ∇Σγ with its virial.
    fn graded(&mut self, with_gradient: bool) {
        let Self { structure, grace, neighbours, elements, mixture, grades, pull_back, out } = self;
        grades.begin(elements.len());
        let grade = |atoms: &[u32], features: &[f64], cotangent: &mut [f64]| {
            grades.add(mixture, elements, atoms, features, cotangent);
        };
        let pull_back = with_gradient.then_some(pull_back);
        grace.evaluate_graded(structure, neighbours, &grade, out, pull_back).expect("known elements");
        grades.finish().expect("finite features");
    }

    /// Multiply-adds of the projection and the quadratic form for all atoms.
    pub fn of_gamma(&self) -> u64 {
        let projection = self.grace.model().projection().map_or(0, |projection| projection.matrix.len());
        (self.structure.len() * (projection + self.mixture.dimension().pow(2))) as u64
    }

    /// Cutoff, Å.
    pub fn cutoff(&self) -> f64 {
        self.grace.cutoff()
    }

    /// Symbols of the model's elements in order.
    pub fn symbols(&self) -> Vec<&'static str> {
        self.grace.species().iter().map(|species| species.symbol()).collect()
    }

    /// Multiply-adds of one call for all atoms, plain or graded.
    pub fn multiply_adds(&self, call: Call) -> u64 {
        self.grace.multiply_adds(matches!(call, Call::Graded))
    }

    /// Directed bonds within the cutoff.
    pub fn bonds(&self) -> usize {
        let cutoff = self.grace.cutoff();
        let within = |i: usize| {
            let d = |n: &atoms::Neighbour| n.displacement(&self.structure, i);
            self.neighbours
                .neighbours_of(i)
                .iter()
                .filter(|n| d(n).iter().map(|x| x * x).sum::<f64>() < cutoff * cutoff)
                .count()
        };
        (0..self.structure.len()).map(within).sum()
    }
}

/// fcc with alternating elements, every atom displaced by up to 0.15 Å along each axis.
fn crystal(model: &GraceModel, cells: usize, edge: f64) -> Structure {
    const SITES: [[f64; 3]; 4] = [[0.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]];
    let mut state = 1_u64;
    let mut noise = || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        0.3 * ((state >> 11) as f64 / (1_u64 << 53) as f64 - 0.5)
    };
    let mut positions = Vec::new();
    for cell in 0..cells * cells * cells {
        let corner = [cell / (cells * cells), cell / cells % cells, cell % cells];
        for site in SITES {
            positions.push(std::array::from_fn(|a| edge * (corner[a] as f64 + site[a]) + noise()));
        }
    }
    let length = edge * cells as f64;
    let known = model.elements();
    Structure {
        species: (0..positions.len()).map(|k| known[k % known.len()]).collect(),
        positions,
        cell: Cell::orthorhombic(length, length, length),
        periodic: [true; 3],
    }
}
