//! Baselines against small dense evaluations.

mod max_vol;
mod scores;
mod stored;

use std::sync::Arc;

use calm::baselines::{Baseline, BaselineKind, BaselineSettings, Builder};
use calm::{Component, Mixture, Statistics};

use crate::common::Random;

/// A structure: element indices and features.
type Frame = (Vec<usize>, Vec<f64>);

/// Structures of 1 to 9 atoms of `elements` elements, with features of differing widths about 1.
fn frames(seed: u64, dimension: usize, elements: usize, count: usize) -> Vec<Frame> {
    let mut random = Random(seed);
    let mut index = |below: usize| (0.5 * (random.next() + 1.0) * below as f64) as usize;
    let sizes: Vec<Vec<usize>> =
        (0..count).map(|_| (0..1 + index(9)).map(|_| index(elements)).collect()).collect();
    let row = |random: &mut Random| -> Vec<f64> {
        (0..dimension).map(|axis| 1.0 + random.next() * 0.8_f64.powi(axis as i32)).collect()
    };
    let mut random = Random(seed ^ 77);
    sizes.into_iter().map(|of| (of.clone(), of.iter().flat_map(|_| row(&mut random)).collect())).collect()
}

/// Two components for each element, with statistics and diagonal covariances.
fn mixture(seed: u64, dimension: usize, elements: usize) -> Mixture {
    let mut random = Random(seed);
    let mut component = |count: f64| {
        let centroid: Vec<f64> = random.take(dimension).iter().map(|x| 1.0 + x).collect();
        let (mut inverse, mut scatter) = (vec![0.0; dimension * dimension], vec![0.0; dimension * dimension]);
        for axis in 0..dimension {
            let variance = 0.02 + 0.01 * axis as f64;
            inverse[axis * (dimension + 1)] = 1.0 / (variance + 1e-6);
            scatter[axis * (dimension + 1)] = variance * count;
        }
        let statistics = Statistics { scatter, count, effective_count: count };
        Arc::new(Component::new(centroid, inverse, 1.0, Some(statistics)).unwrap())
    };
    Mixture::new(0, (0..elements).map(|e| vec![component(30.0 + e as f64), component(10.0)]).collect())
        .unwrap()
}

/// All sweeps over these structures.
fn built(
    kind: BaselineKind,
    settings: &BaselineSettings,
    frames: &[Frame],
    dimension: usize,
    mixture: &Mixture,
) -> Baseline {
    let elements = mixture.element_count();
    let mut builder = Builder::new(kind, settings, dimension, elements, Some(mixture)).unwrap();
    while builder.needs_sweep() {
        for (elements, features) in frames {
            builder.add(elements, features).unwrap();
        }
        builder.end_sweep();
    }
    builder.finish().unwrap()
}

/// The elements and features of all structures in one batch.
fn joined(frames: &[Frame]) -> Frame {
    frames.iter().cloned().fold(Frame::default(), |(mut elements, mut features), frame| {
        elements.extend(frame.0);
        features.extend(frame.1);
        (elements, features)
    })
}

/// Solves M x = b by elimination with pivoting; the determinant of M comes with x.
fn solve(mut matrix: Vec<Vec<f64>>, mut right: Vec<f64>) -> (Vec<f64>, f64) {
    let (n, mut determinant) = (right.len(), 1.0);
    for k in 0..n {
        let pivot = (k..n).max_by(|a, b| matrix[*a][k].abs().total_cmp(&matrix[*b][k].abs())).unwrap();
        determinant *= if pivot == k { 1.0 } else { -1.0 };
        matrix.swap(k, pivot);
        right.swap(k, pivot);
        determinant *= matrix[k][k];
        let own = matrix[k].clone();
        for row in k + 1..n {
            let factor = matrix[row][k] / own[k];
            matrix[row].iter_mut().zip(&own).skip(k).for_each(|(x, own)| *x -= factor * own);
            right[row] -= factor * right[k];
        }
    }
    for k in (0..n).rev() {
        let known: f64 = (k + 1..n).map(|column| matrix[k][column] * right[column]).sum();
        right[k] = (right[k] - known) / matrix[k][k];
    }
    (right, determinant)
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// A Aᵀ of rows.
fn gram(rows: &[&[f64]]) -> Vec<Vec<f64>> {
    rows.iter().map(|a| rows.iter().map(|b| dot(a, b)).collect()).collect()
}
