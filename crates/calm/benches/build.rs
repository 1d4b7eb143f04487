//! How fast the passes of a build are on one thread. Prints a table.
//!
//! Passes 2 and 3 are compared with the bare matrix products of the same shapes in the same run: for each block of 128
//! atoms, XᵀX (its lower half, in pass 2) or XS (in pass 3) of ready matrices, and no assignment, copy or histogram. The
//! numbers are medians of repeated rounds, in which the passes and their products alternate.
//!
//! `cargo bench -p calm --bench build -- 50000` takes another number of atoms than 20,000.

use std::hint::black_box;
use std::time::{Duration, Instant};

use calm::build::{BuildSettings, BuiltComponent, CalibrationPass, ScatterPass, ShardClustering, components};
use faer::linalg::matmul::matmul;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::{Accum, Mat, MatMut, MatRef, Par};

const DIMENSION: usize = 130;
const CLUSTERS: usize = 8;
const ATOMS: usize = 20_000;
/// Atoms of a batch, as a caller streams them.
const BATCH: usize = 512;
/// Atoms of a block in passes 2 and 3.
const BLOCK: usize = 128;
const ROUNDS: usize = 31;

/// xorshift64*.
struct Random(u64);

impl Random {
    /// Uniform in (−1, 1).
    fn next(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }
}

struct Data {
    features: Vec<f64>,
    weights: Vec<f64>,
    centroids: Vec<f64>,
}

/// Atoms around random centres, in random order.
fn data(atoms: usize) -> Data {
    let mut random = Random(11);
    let centroids: Vec<f64> = (0..CLUSTERS * DIMENSION).map(|_| random.next()).collect();
    let mut features = Vec::with_capacity(atoms * DIMENSION);
    for _ in 0..atoms {
        let cluster = ((random.next() + 1.0) / 2.0 * CLUSTERS as f64) as usize;
        let centre = &centroids[cluster * DIMENSION..][..DIMENSION];
        features.extend(centre.iter().map(|c| c + 0.3 * random.next()));
    }
    Data { features, weights: vec![1.0; atoms], centroids }
}

impl Data {
    fn batches(&self) -> impl Iterator<Item = (&[f64], &[f64])> {
        self.features.chunks(BATCH * DIMENSION).zip(self.weights.chunks(BATCH))
    }

    fn blocks(&self) -> impl Iterator<Item = MatRef<'_, f64>> {
        let blocks = self.features.chunks(BLOCK * DIMENSION);
        blocks.map(|block| MatRef::from_row_major_slice(block, block.len() / DIMENSION, DIMENSION))
    }

    fn clustering(&self, settings: &BuildSettings) {
        let mut pass = ShardClustering::new(settings, 0, 0).expect("settings");
        self.batches().for_each(|(features, weights)| pass.add(features, weights).expect("features"));
        black_box(pass.finish());
    }

    fn scatter(&self) -> Vec<BuiltComponent> {
        let mut pass = ScatterPass::new(DIMENSION, &self.centroids).expect("centroids");
        self.batches().for_each(|(features, weights)| pass.add(features, weights).expect("features"));
        components(&self.centroids, &black_box(pass.finish())).expect("components")
    }

    fn calibration(&self, components: &[BuiltComponent]) {
        let mut pass = CalibrationPass::new(components).expect("components");
        self.batches().for_each(|(features, weights)| pass.add(features, weights).expect("features"));
        black_box(pass.finish());
    }

    /// XᵀX of each block, added to the sum of a cluster.
    fn bare_scatter(&self, half: bool) {
        let mut sums = vec![Mat::<f64>::zeros(DIMENSION, DIMENSION); CLUSTERS];
        let lower = if half { BlockStructure::TriangularLower } else { BlockStructure::Rectangular };
        let rectangular = BlockStructure::Rectangular;
        for (block, sum) in self.blocks().zip((0..CLUSTERS).cycle()) {
            let (left, sum) = (block.transpose(), &mut sums[sum]);
            triangular::matmul(sum, lower, Accum::Add, left, rectangular, block, rectangular, 1.0, Par::Seq);
        }
        black_box(sums);
    }

    /// XS of each block.
    fn bare_calibration(&self, components: &[BuiltComponent]) {
        let mut products = vec![0.0; BLOCK * DIMENSION];
        for (block, component) in self.blocks().zip(components.iter().cycle()) {
            let out = &mut products[..block.nrows() * DIMENSION];
            let out = MatMut::from_row_major_slice_mut(out, block.nrows(), DIMENSION);
            let inverse = MatRef::from_row_major_slice(&component.inverse, DIMENSION, DIMENSION);
            matmul(out, Accum::Replace, block, inverse, 1.0, Par::Seq);
            black_box(&mut products);
        }
    }
}

fn time(work: impl FnOnce()) -> Duration {
    let start = Instant::now();
    work();
    start.elapsed()
}

fn median(mut times: Vec<Duration>) -> f64 {
    times.sort();
    times[times.len() / 2].as_secs_f64()
}

fn main() {
    let atoms = std::env::args().find_map(|argument| argument.parse().ok()).unwrap_or(ATOMS);
    let data = data(atoms);
    let settings =
        BuildSettings { dimension: DIMENSION, seed: 1, candidates: vec![1, 2, 4, 8, 16], shard_size: 1 };
    let components = data.scatter();
    let mut times: [Vec<Duration>; 6] = Default::default();
    for _ in 0..ROUNDS {
        times[0].push(time(|| data.clustering(&settings)));
        // Without the inverses, which do not depend on the number of atoms.
        times[1].push(time(|| {
            let mut pass = ScatterPass::new(DIMENSION, &data.centroids).expect("centroids");
            data.batches().for_each(|(features, weights)| pass.add(features, weights).expect("features"));
            black_box(pass.finish());
        }));
        times[2].push(time(|| data.bare_scatter(true)));
        times[3].push(time(|| data.bare_scatter(false)));
        times[4].push(time(|| data.calibration(&components)));
        times[5].push(time(|| data.bare_calibration(&components)));
    }
    let [first, second, half, full, third, bare] = times.map(median);
    let rate = |seconds: f64| 1e-3 * atoms as f64 / seconds;
    println!("{atoms} atoms, D = {DIMENSION}, {CLUSTERS} components, one thread");
    println!("pass                           10³ atoms/s   share of the product's rate");
    println!("1, K = 1, 2, 4, 8, 16          {:>11.0}", rate(first));
    println!(
        "2                              {:>11.0}   {:.2} (half), {:.2} (full)",
        rate(second),
        half / second,
        full / second
    );
    println!("  XᵀX, lower half              {:>11.0}", rate(half));
    println!("  XᵀX, all                     {:>11.0}", rate(full));
    println!("3                              {:>11.0}   {:.2}", rate(third), bare / third);
    println!("  XS                           {:>11.0}", rate(bare));
}
