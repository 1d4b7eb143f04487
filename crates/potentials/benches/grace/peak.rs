//! What the core can do: multiply-adds a second of matrix products, on one thread.

use std::time::Instant;

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, Par};

/// Rows, inner and outer dimension: a large product, and those of a map of channels and of the projection.
const SHAPES: [[usize; 3]; 3] = [[512, 512, 512], [36, 64, 64], [108, 5664, 128]];

/// Prints the rates and returns the highest, multiply-adds a second.
pub fn report() -> f64 {
    let mut peak: f64 = 0.0;
    println!("matrix products of faer, one thread");
    for shape in SHAPES {
        let rate = rate(shape);
        println!("  {shape:?}: {:.1} G multiply-adds/s", 1e-9 * rate);
        peak = peak.max(rate);
    }
    peak
}

/// The highest rate met in half a second.
fn rate([rows, inner, columns]: [usize; 3]) -> f64 {
    let a = Mat::from_fn(rows, inner, |i, j| ((i + 2 * j) % 7) as f64 - 3.0);
    let b = Mat::from_fn(inner, columns, |i, j| ((3 * i + j) % 5) as f64 - 2.0);
    let mut out = Mat::zeros(rows, columns);
    let products = (20_000_000 / (rows * inner * columns)).max(1);
    let (begin, mut best) = (Instant::now(), f64::INFINITY);
    while begin.elapsed().as_secs_f64() < 0.5 {
        let start = Instant::now();
        for _ in 0..products {
            matmul(out.as_mut(), Accum::Replace, a.as_ref(), b.as_ref(), 1.0, Par::Seq);
        }
        best = best.min(start.elapsed().as_secs_f64() / products as f64);
    }
    (rows * inner * columns) as f64 / best
}
