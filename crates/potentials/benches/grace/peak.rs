//! Peak performance of the core: multiply-adds per second of matrix products on one thread.

use std::time::Instant;

use faer::linalg::matmul::matmul;
use faer::traits::ComplexField;
use faer::{Accum, Mat, Par};
use potentials::grace::Precision;

/// Rows, inner and outer dimension of a large product, of a channel map and of the projection.
const SHAPES: [[usize; 3]; 3] = [[512, 512, 512], [36, 64, 64], [108, 5664, 128]];

/// Multiply-adds per second.
#[derive(Clone, Copy, Debug, Default)]
pub struct Rates {
    pub highest: f64,
    /// For the shape of the projection.
    pub projection: f64,
}

/// The rates of each precision.
#[derive(Clone, Copy, Default)]
pub struct Peak {
    double: Rates,
    single: Rates,
}

impl Peak {
    /// The rates for the per-channel numbers of this precision.
    pub fn rates(self, precision: Precision) -> Rates {
        match precision {
            Precision::Double => self.double,
            Precision::Mixed => self.single,
        }
    }
}

/// Prints the rates and returns them.
pub fn report() -> Peak {
    println!("matrix products of faer, one thread");
    let rates = SHAPES.map(|shape| {
        let (double, single) = (rate::<f64>(shape), rate::<f32>(shape));
        println!(
            "  {shape:?}: {:.1} G multiply-adds/s, in single precision {:.1}",
            1e-9 * double,
            1e-9 * single
        );
        (double, single)
    });
    let of = |rates: [f64; 3]| Rates { highest: rates.into_iter().fold(0.0, f64::max), projection: rates[2] };
    Peak { double: of(rates.map(|(double, _)| double)), single: of(rates.map(|(_, single)| single)) }
}

/// The highest rate within half a second.
fn rate<T: ComplexField + From<i8>>([rows, inner, columns]: [usize; 3]) -> f64 {
    let small = |k: usize, n: usize| T::from((k % n) as i8 - n as i8 / 2);
    let a = Mat::from_fn(rows, inner, |i, j| small(i + 2 * j, 7));
    let b = Mat::from_fn(inner, columns, |i, j| small(3 * i + j, 5));
    let mut out = Mat::<T>::zeros(rows, columns);
    let products = (20_000_000 / (rows * inner * columns)).max(1);
    let (begin, mut best) = (Instant::now(), f64::INFINITY);
    while begin.elapsed().as_secs_f64() < 0.5 {
        let start = Instant::now();
        for _ in 0..products {
            matmul(out.as_mut(), Accum::Replace, a.as_ref(), b.as_ref(), T::from(1), Par::Seq);
        }
        best = best.min(start.elapsed().as_secs_f64() / products as f64);
    }
    (rows * inner * columns) as f64 / best
}
