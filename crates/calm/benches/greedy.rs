//! Greedy selection alone, without reading and grading the pool. Prints a table.
//!
//! `CALMWALK_SELECTION=WORK cargo bench -p calm --bench greedy`, where WORK is the folder of `benches/selection/measure.py`, whose
//! pool of structures of 108 aluminium atoms is graded by the artifact of `configs/data/al_eam_1l`. Times are processor times of
//! one thread, medians of rounds: of everything up to the last pick, and of what comes after one structure was picked at random,
//! which says what is left.

use std::path::Path;
use std::time::Duration;

use calm::selection::{Greedy, Pool, Window};
use calm::{Artifact, Grades, Mixture};
use rustix::time::{ClockId, clock_gettime};

/// Atoms of a structure.
const ATOMS: usize = 108;
const ROUNDS: usize = 7;

fn load(work: &Path, mixture: &Mixture) -> Pool {
    let path = work.join("z.npy");
    let file = std::fs::File::open(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let array = npyz::NpyFile::new(std::io::BufReader::new(file)).expect("an array");
    let features: Vec<f64> = array.into_vec().expect("f8");
    let window = Window { above: 1.0, up_to: f64::INFINITY };
    let mut pool = Pool::new(mixture.dimension(), window, false, usize::MAX, std::env::temp_dir());
    let (elements, mut grades) = ([0; ATOMS], Grades::default());
    for structure in features.chunks_exact(ATOMS * mixture.dimension()) {
        grades.evaluate(mixture, &elements, structure, None).expect("features of this mixture");
        pool.push(&elements, &grades.component, &grades.gamma, structure).expect("memory");
    }
    pool
}

/// Processor time of this thread.
fn now() -> Duration {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    Duration::new(time.tv_sec.unsigned_abs(), time.tv_nsec as u32)
}

/// What is found, and the median time, ms.
fn measured<T>(mut work: impl FnMut() -> T) -> (T, f64) {
    let mut times = Vec::new();
    loop {
        let start = now();
        let found = work();
        times.push(1e3 * (now() - start).as_secs_f64());
        if times.len() == ROUNDS {
            times.sort_by(f64::total_cmp);
            return (found, times[ROUNDS / 2]);
        }
    }
}

fn main() {
    let Some(work) = std::env::var_os("CALMWALK_SELECTION") else {
        eprintln!("CALMWALK_SELECTION is not set: expected the folder of benches/selection/measure.py");
        return;
    };
    let artifact = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/data/al_eam_1l/gmm_artifacts.npz");
    let mixture = Artifact::load(artifact).expect("an artifact").mixture;
    let pool = load(Path::new(&work), &mixture);
    let target = 1.25.try_into().expect("a positive number");
    let greedy = |picked: &[usize]| {
        Greedy::new(&pool, &mixture, target, picked.iter().copied()).expect("a pool of this mixture")
    };
    let (picks, all) = measured(|| {
        let mut greedy = greedy(&[]);
        std::iter::from_fn(|| greedy.pick().expect("memory")).map(|pick| pick.structure).collect::<Vec<_>>()
    });
    let (left, one) = measured(|| greedy(&[0]).gamma_left().expect("memory"));
    println!("{} structures, {} atoms above 1", pool.len(), pool.atoms().len());
    println!(
        "{} picks in {all:.1} ms; the largest γ left after one pick, {left:?}, in {one:.1} ms",
        picks.len()
    );
    println!("{picks:?}");
}
