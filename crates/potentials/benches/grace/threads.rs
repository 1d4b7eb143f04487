//! Two threads against one, on the larger crystal.

use std::hint::black_box;
use std::time::Instant;

use atoms::Evaluation;
use potentials::grace::{Precision, Threads};

use crate::case::{Case, Model};
use crate::{SECONDS, quantiles};

/// Prints how many times as fast two threads are; both are called in turn.
pub fn report(model: &Model, cells: usize) {
    let [mut one, mut two] = [1, 2].map(|n| {
        Case::with_threads(model, cells, Precision::Double, Threads::new(n).expect("the system has threads"))
    });
    let mut out = Evaluation::default();
    let mut seconds = |case: &mut Case, is_graded: bool| {
        let start = Instant::now();
        if is_graded {
            case.graded(black_box(&mut out))
        } else {
            case.plain(black_box(&mut out))
        }
        start.elapsed().as_secs_f64()
    };
    for (name, is_graded) in [("energy, forces", false), ("with γ and ∇Σγ", true)] {
        let (begin, mut ratios) = (Instant::now(), Vec::new());
        while begin.elapsed().as_secs_f64() < SECONDS || ratios.len() < 5 {
            ratios.push(seconds(&mut one, is_graded) / seconds(&mut two, is_graded));
        }
        let [low, median, high] = quantiles(&ratios);
        println!("    {name}, two threads: {median:.2} times as fast ({low:.2} to {high:.2})");
    }
}
