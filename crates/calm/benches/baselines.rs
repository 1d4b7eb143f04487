//! MaxVol and LLPR against NumPy and SciPy on the same arrays, one thread each. Prints a table.
//!
//! `CALMWALK_PYTHON=python3 cargo bench -p calm --bench baselines` needs NumPy and SciPy. NumPy holds all features; calmwalk
//! receives them structure by structure, in as many sweeps as it needs. Times are medians of rounds.

use std::path::Path;
use std::process::Command;
use std::time::Instant;

use calm::baselines::{Baseline, BaselineKind, BaselineSettings, Builder};
use npyz::WriterBuilder;

const DIMENSION: usize = 130;
const ATOMS: usize = 20_000;
/// Atoms of a structure.
const STRUCTURE: usize = 50;
const ROUNDS: usize = 5;

/// xorshift64*.
struct Random(u64);

impl Random {
    /// About normal, of width 1.
    fn next(&mut self) -> f64 {
        (0..6).map(|_| self.uniform()).sum::<f64>() / std::f64::consts::SQRT_2
    }

    /// In (−1, 1).
    fn uniform(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }
}

/// `[atoms × D]`; widths fall off along the axes by a factor of 10⁴.
fn features(seed: u64, atoms: usize) -> Vec<f64> {
    let mut random = Random(seed);
    let width = |axis: usize| 10_f64.powf(-4.0 * axis as f64 / DIMENSION as f64);
    (0..atoms * DIMENSION).map(|k| 0.5 + width(k % DIMENSION) * random.next()).collect()
}

fn save(path: &Path, features: &[f64]) {
    let file = std::fs::File::create(path).expect("a file");
    let shape = [(features.len() / DIMENSION) as u64, DIMENSION as u64];
    let options = npyz::WriteOptions::new().default_dtype().shape(&shape);
    let mut writer = options.writer(std::io::BufWriter::new(file)).begin_nd().expect("an array");
    writer.extend(features.iter().copied()).and_then(|()| writer.finish()).expect("an array");
}

fn build(kind: BaselineKind, settings: &BaselineSettings, features: &[f64]) -> (Baseline, usize) {
    let mut builder = Builder::new(kind, settings, DIMENSION, 1, None).expect("settings");
    let (elements, mut sweeps) = ([0; STRUCTURE], 0);
    while builder.needs_sweep() {
        for structure in features.chunks_exact(STRUCTURE * DIMENSION) {
            builder.add(&elements, structure).expect("features");
        }
        builder.end_sweep();
        sweeps += 1;
    }
    (builder.finish().expect("data"), sweeps)
}

fn measured<T>(mut work: impl FnMut() -> T) -> (T, f64) {
    let mut times = Vec::new();
    loop {
        let start = Instant::now();
        let found = work();
        times.push(start.elapsed().as_secs_f64());
        if times.len() == ROUNDS {
            times.sort_by(f64::total_cmp);
            return (found, times[ROUNDS / 2]);
        }
    }
}

fn main() {
    let Some(python) = std::env::var_os("CALMWALK_PYTHON") else {
        eprintln!("CALMWALK_PYTHON is not set: expected a Python with NumPy and SciPy");
        return;
    };
    let directory = tempfile::tempdir().expect("a directory");
    let (training, queries) = (features(5, ATOMS), features(6, ATOMS));
    save(&directory.path().join("features.npy"), &training);
    save(&directory.path().join("queries.npy"), &queries);
    let settings = BaselineSettings { regularisation: 1e-9, ..BaselineSettings::default() };
    let mut command = Command::new(python);
    command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/baselines.py")).arg(directory.path());
    command.args(["--structure", &STRUCTURE.to_string(), "--rounds", &ROUNDS.to_string()]);
    command.args(["--tolerance", &settings.tolerance.to_string()]);
    command.args(["--regularisation", &settings.regularisation.to_string()]);
    let output = command.output().expect("Python starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let peer: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");

    let elements = vec![0; ATOMS];
    let ((active, sweeps), maxvol) =
        measured(|| build(BaselineKind::DOptimalityElement, &settings, &training));
    let (_, score) = measured(|| active.score(&elements, &queries).expect("features"));
    let (uncertainties, llpr) = measured(|| {
        build(BaselineKind::Llpr, &settings, &training).0.score(&elements, &queries).expect("features")
    });
    check(directory.path(), &uncertainties);
    let rows = |name: &str, own: f64| {
        let other = peer[name].as_f64().expect("a time");
        println!("{name:<28}{:>12.1}{:>14.1}{:>9.2}", 1e3 * own, 1e3 * other, other / own);
    };
    println!(
        "{ATOMS} atoms, D = {DIMENSION}, one thread; {sweeps} sweeps, NumPy's exchanges {}",
        peer["exchanges"]
    );
    println!("                             calmwalk, ms     NumPy, ms    ratio");
    rows("maxvol", maxvol);
    rows("score", score);
    rows("llpr", llpr);
    println!(
        "log of the volume: {:.3} and {:.3}",
        log_volume(&active),
        peer["log_volume"].as_f64().expect("a number")
    );
}

/// LLPR's scores are those of NumPy.
fn check(directory: &Path, found: &[f64]) {
    let file = std::fs::File::open(directory.join("llpr.npy")).expect("scores");
    let expected: Vec<f64> =
        npyz::NpyFile::new(std::io::BufReader::new(file)).expect("an array").into_vec().expect("f8");
    let worst = found.iter().zip(&expected).map(|(a, b)| (a / b - 1.0).abs()).fold(0.0, f64::max);
    assert!(worst < 1e-6, "LLPR deviates by {worst:e}");
}

/// log |det A|.
fn log_volume(baseline: &Baseline) -> f64 {
    let Baseline::DOptimality(found) = baseline else { return f64::NAN };
    let rows = found.active_rows(0).expect("one group");
    let matrix = faer::MatRef::from_row_major_slice(rows, DIMENSION, DIMENSION);
    let factors = faer::linalg::solvers::PartialPivLu::new(matrix);
    (0..DIMENSION).map(|k| factors.U()[(k, k)].abs().ln()).sum()
}
