//! The build of a mixture from training data.

mod artifact_version;
mod clustering;
mod golden;
mod passes;
mod stored;

use calm::Projection;
use calm::build::{
    BuildSettings, BuiltComponent, BuiltElement, CalibrationPass, ElementHistograms, ElementSums,
    ScatterPass, components,
};

use crate::common::Random;

/// Atoms around centres: `[atoms × D]`, and the index of the centre of each. The widths fall off along the axes.
struct Blobs {
    centres: Vec<Vec<f64>>,
    features: Vec<f64>,
    labels: Vec<usize>,
}

impl Blobs {
    /// `distance` scales the centres, whose coordinates are uniform in (−1, 1); the noise has a width of about 1.
    fn new(seed: u64, dimension: usize, centres: usize, atoms: usize, distance: f64) -> Self {
        let mut random = Random(seed);
        let centres: Vec<Vec<f64>> = (0..centres)
            .map(|_| random.take(dimension).iter().map(|value| distance * value).collect())
            .collect();
        let labels: Vec<usize> =
            (0..atoms).map(|_| ((random.next() + 1.0) / 2.0 * centres.len() as f64) as usize).collect();
        let mut features = Vec::with_capacity(atoms * dimension);
        for &label in &labels {
            for (axis, centre) in centres[label].iter().enumerate() {
                // The sum of three uniform numbers in (−1, 1) has variance 1.
                let noise = random.next() + random.next() + random.next();
                features.push(centre + noise * 0.95_f64.powi(axis as i32));
            }
        }
        Self { centres, features, labels }
    }

    fn atoms(&self) -> usize {
        self.labels.len()
    }
}

fn settings(dimension: usize, candidates: &[usize]) -> BuildSettings {
    BuildSettings { dimension, seed: 42, candidates: candidates.to_vec(), shard_size: 100 }
}

/// Weights between 0 and 2.
fn weights(seed: u64, atoms: usize) -> Vec<f64> {
    Random(seed).take(atoms).iter().map(|value| value + 1.0).collect()
}

/// Pass 2 over one shard, in batches of these sizes in turn.
fn scatter(
    dimension: usize,
    centroids: &[f64],
    features: &[f64],
    weights: &[f64],
    sizes: &[usize],
) -> ElementSums {
    let mut pass = ScatterPass::new(dimension, centroids).unwrap();
    for (features, weights) in batches(dimension, features, weights, sizes) {
        pass.add(features, weights).unwrap();
    }
    pass.finish()
}

/// Pass 3 over one shard, in batches of these sizes in turn.
fn calibrate(
    components: &[BuiltComponent],
    features: &[f64],
    weights: &[f64],
    sizes: &[usize],
) -> ElementHistograms {
    let mut pass = CalibrationPass::new(components).unwrap();
    for (features, weights) in batches(components[0].centroid.len(), features, weights, sizes) {
        pass.add(features, weights).unwrap();
    }
    pass.finish()
}

fn batches<'a>(
    dimension: usize,
    mut features: &'a [f64],
    mut weights: &'a [f64],
    sizes: &[usize],
) -> Vec<(&'a [f64], &'a [f64])> {
    let mut out = Vec::new();
    for &size in sizes.iter().cycle() {
        if weights.is_empty() {
            break;
        }
        let size = size.min(weights.len());
        let (now, later) = weights.split_at(size);
        let (rows, rest) = features.split_at(size * dimension);
        out.push((rows, now));
        (weights, features) = (later, rest);
    }
    out
}

/// Passes 2 and 3 of one element as one shard.
fn built(dimension: usize, centroids: &[f64], features: &[f64], weights: &[f64]) -> BuiltElement {
    let sums = scatter(dimension, centroids, features, weights, &[1000]);
    let components = components(centroids, &sums).unwrap();
    let histograms = calibrate(&components, features, weights, &[1000]);
    BuiltElement { components, histograms }
}

/// A projection for features of this dimension.
fn projection(dimension: usize) -> Projection {
    Projection {
        matrix: Random(5).take(3 * dimension).into_iter().map(|value| 100.0 * value as f32).collect(),
        rows: 3,
        columns: dimension,
        feature_dimension: dimension,
        asinh: false,
        normalised: true,
        density_channels: false,
        density_scale: 1.0,
    }
}
