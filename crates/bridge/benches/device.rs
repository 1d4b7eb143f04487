//! What the bridge adds to a call of a model in Python, and what batches make of a device. Needs a Python with numpy:
//!
//! `CALMWALK_PYTHON=…/python cargo bench -p bridge --bench device`
//!
//! With `CALMWALK_MODEL` (a file for the adapter named by `CALMWALK_ADAPTER`), the tables are those of a real model instead: walkers with
//! 108 atoms of aluminium, single calls against batches, with two gradients a step and with one (`walk.bias_norm_interval = 10`).
//! `CALMWALK_DEVICE` (cpu), `CALMWALK_PRECISION` (double), `CALMWALK_WALKERS` (64) and `CALMWALK_SECONDS` (20, of each line) say how.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use atoms::{Cell, Evaluation, NeighbourList, Species, Structure};
use bridge::{Device, DeviceService, PythonModel, PythonSettings};
use calm::build::random_projection;
use potentials::grace::{Precision, PullBack, Threads};
use potentials::{ModelWithFeatures, PotentialWithFeatures};
use serde_json::json;
use tokio_util::sync::CancellationToken;
use wire::shm_dir::ShmDir;

fn main() {
    let Some(python) = std::env::var_os("CALMWALK_PYTHON").map(PathBuf::from) else {
        println!("CALMWALK_PYTHON names no Python with numpy: nothing to measure");
        return;
    };
    match (std::env::var_os("CALMWALK_MODEL"), std::env::var("CALMWALK_ADAPTER")) {
        (Some(model), Ok(adapter)) => real(PythonSettings::new(&python, &adapter, Some(Path::new(&model)))),
        _ => {
            overhead(&python);
            simulated(&python);
        }
    }
}

/// The variable `name` of the environment, or `default`.
fn variable<T: std::str::FromStr>(name: &str, default: T) -> T {
    let Ok(text) = std::env::var(name) else { return default };
    text.parse().unwrap_or_else(|_| panic!("{name}={text} cannot be read"))
}

/// A real model.
fn real(mut settings: PythonSettings) {
    settings.device = variable("CALMWALK_DEVICE", "cpu".to_owned());
    settings.precision = match variable("CALMWALK_PRECISION", "double".to_owned()).as_str() {
        "single" => Precision::Mixed,
        "double" => Precision::Double,
        other => panic!("CALMWALK_PRECISION={other}, expected single or double"),
    };
    let (walkers, time) =
        (variable("CALMWALK_WALKERS", 64), Duration::from_secs(variable("CALMWALK_SECONDS", 20)));
    println!(
        "\n{} on {}, {:?}, biased steps of 108 atoms",
        settings.adapter, settings.device, settings.precision
    );
    compare(&settings, 3, &Walkers { number: walkers, norm_interval: 1, time });
    println!("\nthe same, with one gradient for forces and bias in 9 steps of 10");
    compare(&settings, 3, &Walkers { number: walkers, norm_interval: 10, time });
}

fn radial(python: &Path, adapter: &str) -> PythonSettings {
    let model = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../python/tests/data/radial-al-short.json");
    PythonSettings::new(python, adapter, Some(&model))
}

fn start(settings: PythonSettings) -> Arc<Device> {
    Arc::new(Device::start(settings, false, &CancellationToken::new(), |_| {}).expect("a device"))
}

fn projected(model: PythonModel) -> Arc<PythonModel> {
    let features = &model.description().features;
    let projection = random_projection(1, features.dimension, 16, features.blocks.len());
    Arc::new(model.projected(projection).expect("invariants"))
}

/// A call with 500 atoms: what it takes beside the adapter's own time, in this process and through shared memory.
fn overhead(python: &Path) {
    let device = start(radial(python, "radial"));
    let directory = tempfile::tempdir().expect("a directory");
    let place = ShmDir::for_campaign(directory.path()).expect("shared memory");
    let prepared = place.prepare(1 << 26).expect("shared memory");
    let service = DeviceService::open(&device, &place, 1, 2, 1 << 17).expect("a service");
    let shared = PythonModel::shared(
        device.info().description().clone(),
        service.address().clone(),
        CancellationToken::new(),
    );
    let models = [
        ("in one process", projected(PythonModel::local(vec![Arc::clone(&device)]).expect("a model"))),
        ("between processes", projected(shared.expect("a model"))),
    ];
    println!("calls with 500 atoms, ms      whole call   adapter   overhead");
    for (name, model) in models {
        let mut step = BiasedStep::new(&model, 5);
        (0..20).for_each(|_| step.run());
        let (before, begun, steps) = (device.statistics(), Instant::now(), 200);
        (0..steps).for_each(|_| step.run());
        let calls = 2.0 * f64::from(steps);
        let whole = 1e3 * begun.elapsed().as_secs_f64() / calls;
        let adapter = 1e3 * (device.statistics().computed - before.computed) / calls;
        println!("{name:<28} {whole:>10.3} {adapter:>9.3} {:>10.3}", whole - adapter);
    }
    drop((service, prepared));
    let _ = place.remove();
}

/// A device that takes 20 ms for a batch of up to 32 structures.
fn simulated(python: &Path) {
    let mut settings = radial(python, "simulated");
    settings.options = json!({ "base_seconds": 0.02 }).as_object().cloned().unwrap_or_default();
    println!("\nsimulated device, 20 ms a batch, biased steps of 32 atoms");
    let walkers = Walkers { number: 64, norm_interval: 1, time: Duration::from_secs(8) };
    compare(&settings, 2, &walkers);
}

/// Walkers that take biased steps for some time.
struct Walkers {
    number: usize,
    /// Steps from one with two gradients to the next.
    norm_interval: usize,
    time: Duration,
}

/// Biased steps a second of these walkers, with single calls and with batches.
fn compare(settings: &PythonSettings, repeats: usize, walkers: &Walkers) {
    let (time, norm_interval, walkers) = (walkers.time, walkers.norm_interval, walkers.number);
    println!("walkers  max_batch  steps/s  ratio  mean batch  device busy  wait, ms");
    let mut first = None;
    for max_batch in [1, 8, 32, 64] {
        let mut settings = settings.clone();
        settings.max_batch = max_batch.try_into().expect("above zero");
        settings.combined_gradients = norm_interval > 1;
        let device = start(settings);
        let model = projected(PythonModel::local(vec![Arc::clone(&device)]).expect("a model"));
        let _ = device.warm_up(&crystal(repeats, 0), 0.5, walkers);
        let before = device.statistics();
        let end = Instant::now() + time;
        let begun = Instant::now();
        let steps: u64 = std::thread::scope(|scope| {
            let run = |walker: usize| {
                let model = Arc::clone(&model);
                scope.spawn(move || {
                    let (mut step, mut steps) = (BiasedStep::new(&model, repeats), 0);
                    while Instant::now() < end {
                        if (walker + steps).is_multiple_of(norm_interval) {
                            step.run()
                        } else {
                            step.run_combined()
                        }
                        steps += 1;
                    }
                    steps as u64
                })
            };
            let all: Vec<_> = (0..walkers).map(run).collect();
            all.into_iter().map(|one| one.join().expect("a walker")).sum()
        });
        let seconds = begun.elapsed().as_secs_f64();
        let after = device.statistics();
        let rate = steps as f64 / seconds;
        let ratio = rate / *first.get_or_insert(rate);
        let structures = (after.structures - before.structures) as f64;
        println!(
            "{walkers:>7} {max_batch:>10} {rate:>8.1} {ratio:>6.2} {:>11.1} {:>10.0} % {:>9.1}",
            structures / (after.batches - before.batches) as f64,
            100.0 * (after.busy - before.busy) / (after.elapsed - before.elapsed),
            1e3 * (after.waited - before.waited) / structures,
        );
    }
}

/// A walker's potential with a structure.
struct BiasedStep {
    potential: Box<dyn PotentialWithFeatures>,
    structure: Structure,
    list: NeighbourList,
    energy: Evaluation,
    pull_back: PullBack,
}

impl BiasedStep {
    fn new(model: &Arc<PythonModel>, repeats: usize) -> Self {
        let structure = crystal(repeats, 0);
        let potential = Arc::clone(model).evaluator(Threads::default());
        let mut list = NeighbourList::new(potential.cutoff(), 0.5);
        list.update(&structure).expect("a structure");
        Self { potential, structure, list, energy: Evaluation::default(), pull_back: PullBack::default() }
    }

    fn run(&mut self) {
        let grade = |_: &[u32], features: &[f64], out: &mut [f64]| out.copy_from_slice(features);
        let Self { potential, structure, list, energy, pull_back } = self;
        potential.evaluate_graded(structure, list, &grade, energy, Some(pull_back)).expect("a result");
    }

    /// With one gradient for energy and features.
    fn run_combined(&mut self) {
        let grade = |_: &[u32], features: &[f64], out: &mut [f64]| out.copy_from_slice(features);
        let Self { potential, structure, list, energy, .. } = self;
        potential.evaluate_combined(structure, list, &grade, energy).expect("a result");
    }
}

/// A distorted crystal of aluminium, 4 n³ atoms.
fn crystal(repeats: usize, seed: usize) -> Structure {
    let (a, length) = (4.05, 4.05 * repeats as f64);
    let sites = [[0.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]];
    let position = |k: usize| {
        let (cell, site) = (k / 4, sites[k % 4]);
        let corner = [cell % repeats, cell / repeats % repeats, cell / (repeats * repeats)];
        let shift = |axis: usize| 0.1 * (((k + seed) * (axis + 2)) as f64).sin();
        std::array::from_fn(|axis| a * (corner[axis] as f64 + site[axis]) + shift(axis))
    };
    let atoms = 4 * repeats.pow(3);
    Structure {
        species: vec!["Al".parse::<Species>().expect("an element"); atoms],
        positions: (0..atoms).map(position).collect(),
        cell: Cell([[length, 0.0, 0.0], [0.0, length, 0.0], [0.0, 0.0, length]]),
        periodic: [true; 3],
    }
}
