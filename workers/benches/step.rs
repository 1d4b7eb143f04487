//! A complete biased step of a walk against an evaluation of its potential alone: neighbour list, both gradients,
//! mixture, bias, repulsion, integrator, guards and grades, over energies, forces, γ and ∇Σγ. Measures the walk and
//! as many evaluations alternately.
//!
//! `cargo bench -p workers --bench step`; grace1l_paper is in the folder given by `CALMWALK_PEER_DATA`.

mod common;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use atoms::{Evaluation, NeighbourList, Structure};
use calm::{Artifact, BatchedGrades, Mixture};
use common::{Ensemble, TimedWalk, crystal, quartiles};
use potentials::grace::{Grace, GraceModel, PullBack};

/// Number of measurements of a walk and of as many calls.
const ROUNDS: usize = 41;

fn main() {
    let committed = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/data/al_eam_1l");
    let peer_data = std::env::var_os("CALMWALK_PEER_DATA").map(PathBuf::from);
    let models = [
        ("al_eam_1l", Some(committed), 4.05, 250),
        ("grace1l_paper", peer_data.map(|data| data.join("grace/grace1l_paper")), 4.03, 25),
    ];
    for (name, folder, edge, steps) in models {
        match folder {
            Some(folder) if folder.exists() => {
                for ensemble in [Ensemble::ConstantVolume, Ensemble::ConstantPressure { cell_bias: true }] {
                    report(name, &folder, edge, steps, ensemble);
                }
            }
            _ => println!("{name}: not here (CALMWALK_PEER_DATA names the folder that has it)"),
        }
    }
}

fn report(name: &str, folder: &Path, edge: f64, steps: u64, ensemble: Ensemble) {
    let model = Arc::new(GraceModel::load(&folder.join("kokkos.npz")).expect("a model"));
    let mixture = Arc::new(Artifact::load_export(folder.join("kokkos.npz")).expect("a CALM mixture").mixture);
    let mut timed = TimedWalk::new(&model, &mixture, crystal(model.elements(), edge), ensemble);
    let mut call = Call::new(model, mixture, timed.structure.clone());
    let (mut ratios, mut step_times, mut call_times) = (Vec::new(), Vec::new(), Vec::new());
    for round in 0..=ROUNDS {
        let (step, alone) = if round % 2 == 0 {
            let step = timed.seconds(steps);
            (step, call.seconds(steps))
        } else {
            let alone = call.seconds(steps);
            (timed.seconds(steps), alone)
        };
        // The first round is a warm-up.
        if round > 0 {
            ratios.push(step / alone);
            step_times.push(1e3 * step);
            call_times.push(1e3 * alone);
        }
    }
    println!("{name}, {ensemble:?}, {} atoms, assignments of {steps} steps", timed.structure.len());
    for (what, values) in [("step, ms", step_times), ("call, ms", call_times), ("step / call", ratios)] {
        let [low, median, high] = quartiles(values);
        println!("  {what}: {median:.4} ({low:.4} to {high:.4})");
    }
}

/// The potential without a walk.
struct Call {
    grace: Grace,
    mixture: Arc<Mixture>,
    structure: Structure,
    neighbours: NeighbourList,
    elements: Vec<usize>,
    grades: BatchedGrades,
    pull_back: PullBack,
    out: Evaluation,
}

impl Call {
    fn new(model: Arc<GraceModel>, mixture: Arc<Mixture>, structure: Structure) -> Self {
        let mut neighbours = NeighbourList::new(model.cutoff(), 0.5);
        neighbours.update(&structure).expect("a crystal");
        let elements = model.element_indices(&structure.species).expect("elements of the model");
        Self {
            grace: Grace::new(model),
            mixture,
            structure,
            neighbours,
            elements,
            grades: BatchedGrades::default(),
            pull_back: PullBack::default(),
            out: Evaluation::default(),
        }
    }

    /// Time per call, averaged over `calls`.
    fn seconds(&mut self, calls: u64) -> f64 {
        let start = Instant::now();
        for _ in 0..calls {
            let Self { structure, grace, neighbours, elements, mixture, grades, pull_back, out } = &mut *self;
            grades.begin(elements.len());
            let grade = |atoms: &[u32], features: &[f64], cotangent: &mut [f64]| {
                grades.add(mixture, elements, atoms, features, cotangent);
            };
            grace
                .evaluate_graded(structure, neighbours, &grade, out, Some(pull_back))
                .expect("known elements");
            grades.finish().expect("finite features");
        }
        start.elapsed().as_secs_f64() / calls as f64
    }
}
