//! L-BFGS.

use std::collections::VecDeque;
use std::time::Instant;

use crate::objective::Objective;

/// Pairs of steps and changes of the gradient that are remembered.
const MEMORY: usize = 20;

/// L-BFGS (Liu & Nocedal, Math. Program. 45, 503 (1989)) on all structures. A step is halved until the loss falls enough.
/// Each evaluation counts as a pass; shows the best weights after each of `passes`.
pub fn lbfgs(objective: &mut Objective, passes: &[u64]) {
    let mut begun = Instant::now();
    let all: Vec<_> = (0..objective.count()).collect();
    let mut weights = objective.weights();
    let (mut loss, mut gradient) = objective.gradient(&weights, &all);
    let mut pairs: VecDeque<(Vec<f64>, Vec<f64>)> = VecDeque::new();
    let (mut used, last) = (1, passes.iter().copied().max().unwrap_or(0));
    while used < last {
        let direction = two_loops(&gradient, &pairs);
        let slope = dot(&direction, &gradient);
        let mut length = if pairs.is_empty() { 0.1 / dot(&direction, &direction).sqrt() } else { 1.0 };
        let next = loop {
            let tried: Vec<_> = weights.iter().zip(&direction).map(|(w, d)| w + length * d).collect();
            let (value, found) = objective.gradient(&tried, &all);
            used += 1;
            if passes.contains(&used) {
                let best = if value < loss { &tried } else { &weights };
                let seconds = begun.elapsed().as_secs_f64();
                let paused = Instant::now();
                objective.show("L-BFGS", used, seconds, best);
                begun += paused.elapsed();
            }
            if value <= loss + 1e-4 * length * slope || used >= last {
                break (tried, value, found);
            }
            length *= 0.5;
        };
        let (tried, value, found) = next;
        let step: Vec<_> = tried.iter().zip(&weights).map(|(new, old)| new - old).collect();
        let change: Vec<_> = found.iter().zip(&gradient).map(|(new, old)| new - old).collect();
        // Keeps the approximation positive definite.
        if dot(&step, &change) > 1e-10 * dot(&change, &change) {
            pairs.push_back((step, change));
            if pairs.len() > MEMORY {
                pairs.pop_front();
            }
        }
        (weights, loss, gradient) = (tried, value, found);
    }
}

/// −H g, with the approximation of the inverse Hessian that the pairs give.
fn two_loops(gradient: &[f64], pairs: &VecDeque<(Vec<f64>, Vec<f64>)>) -> Vec<f64> {
    let mut q: Vec<_> = gradient.iter().map(|g| -g).collect();
    let mut factors = Vec::new();
    for (step, change) in pairs.iter().rev() {
        let factor = dot(step, &q) / dot(step, change);
        q.iter_mut().zip(change).for_each(|(q, y)| *q -= factor * y);
        factors.push(factor);
    }
    if let Some((step, change)) = pairs.back() {
        let scale = dot(step, change) / dot(change, change);
        q.iter_mut().for_each(|q| *q *= scale);
    }
    for ((step, change), factor) in pairs.iter().zip(factors.into_iter().rev()) {
        let beta = dot(change, &q) / dot(step, change);
        q.iter_mut().zip(step).for_each(|(q, s)| *q += (factor - beta) * s);
    }
    q
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
