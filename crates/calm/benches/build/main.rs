//! How fast the passes of a build are on one thread. Prints a table.
//!
//! Passes 2 and 3 are compared with the bare matrix products of the same shapes: for each block of 128 atoms, XᵀX (all of it, and
//! its lower half as pass 2 computes it) or XS and XT (T is the upper triangle of S in the panels of pass 3, three quarters of the
//! multiply-adds of XS) of ready matrices, and no assignment, copy or histogram. Pass 1 is compared with
//! scikit-learn's mini-batch k-means as gracemaker's builder uses it, if `CALMWALK_GRACEMAKER_PYTHON` names a Python that has
//! it. All ratios are medians over rounds in which a pass and what it is compared with follow each other, on one core; times are
//! those of the processor.
//!
//! `cargo bench -p calm --bench build -- 50000` takes another number of atoms than 20,000.

mod peer;

use std::cmp::Ordering;
use std::hint::black_box;

use calm::build::{BuildSettings, BuiltComponent, CalibrationPass, ScatterPass, ShardClustering, components};
use faer::linalg::matmul::matmul;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::prelude::ReborrowMut;
use faer::{Accum, Mat, MatMut, MatRef, Par};

use peer::Peer;
use rustix::time::{ClockId, clock_gettime};

const DIMENSION: usize = 130;
const CLUSTERS: usize = 8;
const ATOMS: usize = 20_000;
/// Atoms of a batch, as a caller streams them.
const BATCH: usize = 512;
/// Atoms of a block in passes 2 and 3.
const BLOCK: usize = 128;
/// Columns of a panel of the triangle in pass 3.
const PANEL: usize = 66;
const ROUNDS: usize = 31;
/// Rounds of pass 1 with its peer, which takes seconds.
const PEER_ROUNDS: usize = 7;
const CANDIDATES: [usize; 5] = [1, 2, 4, 8, 16];

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

    /// XT of each block, in panels of columns over the rows down to the diagonal.
    fn bare_panels(&self, triangles: &[Vec<f64>]) {
        let mut products = vec![0.0; BLOCK * DIMENSION];
        for (block, triangle) in self.blocks().zip(triangles.iter().cycle()) {
            let out = &mut products[..block.nrows() * DIMENSION];
            let mut out = MatMut::from_row_major_slice_mut(out, block.nrows(), DIMENSION);
            let triangle = MatRef::from_row_major_slice(triangle, DIMENSION, DIMENSION);
            for first in (0..DIMENSION).step_by(PANEL) {
                let columns = PANEL.min(DIMENSION - first);
                let panel = triangle.submatrix(0, first, first + columns, columns);
                let out = out.rb_mut().subcols_mut(first, columns);
                matmul(out, Accum::Replace, block.subcols(0, first + columns), panel, 1.0, Par::Seq);
            }
            black_box(&mut products);
        }
    }
}

/// T of S: T_ij = 2 S_ij for i < j, T_ii = S_ii.
fn upper_triangle(inverse: &[f64]) -> Vec<f64> {
    let element = |(index, value): (usize, &f64)| match (index / DIMENSION).cmp(&(index % DIMENSION)) {
        Ordering::Less => 2.0 * value,
        Ordering::Equal => *value,
        Ordering::Greater => 0.0,
    };
    inverse.iter().enumerate().map(element).collect()
}

/// Processor time of this thread, s: other programs disturb it less than wall time.
fn seconds(work: impl FnOnce()) -> f64 {
    let now = || {
        let time = clock_gettime(ClockId::ThreadCPUTime);
        time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
    };
    let start = now();
    work();
    now() - start
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Times of a pass and of its reference, round by round.
#[derive(Default)]
struct Pair {
    own: Vec<f64>,
    other: Vec<f64>,
}

impl Pair {
    fn push(&mut self, own: f64, other: f64) {
        self.own.push(own);
        self.other.push(other);
    }

    /// A row of the table. The ratio is that of the rates, ours to the other's, with quartiles.
    fn print(self, name: &str, other: &str, atoms: usize) {
        let rate = |seconds: f64| 1e-3 * atoms as f64 / seconds;
        let mut ratios: Vec<f64> = self.own.iter().zip(&self.other).map(|(own, other)| other / own).collect();
        ratios.sort_by(f64::total_cmp);
        let quantile = |q: usize| ratios[(ratios.len() - 1) * q / 4];
        println!(
            "{name:30} {:>9.0}   {other:22} {:>9.0}   {:.2} ({:.2} to {:.2})",
            rate(median(self.own)),
            rate(median(self.other)),
            quantile(2),
            quantile(1),
            quantile(3)
        );
    }
}

fn main() {
    let atoms = std::env::args().find_map(|argument| argument.parse().ok()).unwrap_or(ATOMS);
    let data = data(atoms);
    let settings =
        BuildSettings { dimension: DIMENSION, seed: 1, candidates: CANDIDATES.to_vec(), shard_size: 1 };
    let components = data.scatter();
    let mut peer = Peer::start(&data.features, DIMENSION, BATCH, &CANDIDATES);
    println!(
        "{atoms} atoms, D = {DIMENSION}, {CLUSTERS} components, one thread; 10³ atoms/s, ratio of the rates (quartiles)"
    );
    match &mut peer {
        Some(peer) => {
            let mut first = Pair::default();
            for _ in 0..PEER_ROUNDS {
                first.push(seconds(|| data.clustering(&settings)), peer.seconds());
            }
            first.print("1, K = 1, 2, 4, 8, 16", "scikit-learn", atoms);
        }
        None => {
            let rates = (0..PEER_ROUNDS).map(|_| seconds(|| data.clustering(&settings))).collect();
            println!("{:30} {:>9.0}", "1, K = 1, 2, 4, 8, 16", 1e-3 * atoms as f64 / median(rates));
        }
    }
    drop(peer);
    let triangles: Vec<_> = components.iter().map(|component| upper_triangle(&component.inverse)).collect();
    let [mut half, mut full, mut whole, mut panels] =
        [const { Pair { own: Vec::new(), other: Vec::new() } }; 4];
    for _ in 0..ROUNDS {
        // Without the inverses, which do not depend on the number of atoms.
        let scatter = || {
            let mut pass = ScatterPass::new(DIMENSION, &data.centroids).expect("centroids");
            data.batches().for_each(|(features, weights)| pass.add(features, weights).expect("features"));
            black_box(pass.finish());
        };
        half.push(seconds(scatter), seconds(|| data.bare_scatter(true)));
        full.push(seconds(scatter), seconds(|| data.bare_scatter(false)));
        whole.push(seconds(|| data.calibration(&components)), seconds(|| data.bare_calibration(&components)));
        panels.push(seconds(|| data.calibration(&components)), seconds(|| data.bare_panels(&triangles)));
    }
    half.print("2", "XᵀX, lower half", atoms);
    full.print("2", "XᵀX, all", atoms);
    whole.print("3", "XS", atoms);
    panels.print("3", "XT, triangle in panels", atoms);
}
