//! The search for pairs, with features of pairs and triples of atoms, whose octagon is known, and with a model.

use std::path::Path;
use std::sync::Arc;

use atoms::Vec3;
use atoms::cell::{dot, norm};
use potentials::grace::GraceModel;

use super::environments::{EnvironmentDifference, random_neighbours};
use super::feature_match::{AllowedDistances, FeatureMatch};
use super::lbfgs::Lbfgs;
use super::null_space::NullSpaceWalk;
use crate::calm_validation::random::RandomSequence;
use crate::features::FeatureCalculator;

/// Neighbours on an octagon of radius 1.3.
fn octagon(places: [u8; 4]) -> Vec<Vec3> {
    let place = |k: u8| {
        let (y, x) = (std::f64::consts::FRAC_PI_4 * f64::from(k)).sin_cos();
        [1.3 * x, 1.3 * y, 0.0]
    };
    places.map(place).to_vec()
}

fn displaced(neighbours: &[Vec3], size: f64, sequence: u64) -> Vec<Vec3> {
    let mut random = RandomSequence::new(2, sequence);
    neighbours.iter().map(|r| r.map(|x| x + size * random.normal())).collect()
}

/// Σ_i w_i and Σ_ij w_i w_j P_l(cos θ_ij), w = exp(−k r² / 4), for k = 1, 2 and l = 1 … 4: a power spectrum.
fn power_spectrum(neighbours: &[Vec3]) -> Vec<f64> {
    let mut features = Vec::new();
    for k in [1.0, 2.0] {
        let weights: Vec<_> = neighbours.iter().map(|r| (-k * dot(*r, *r) / 4.0).exp()).collect();
        features.push(weights.iter().sum());
        let mut sums = [0.0; 4];
        for (a, w) in neighbours.iter().zip(&weights) {
            for (b, v) in neighbours.iter().zip(&weights) {
                let x = dot(*a, *b) / (norm(*a) * norm(*b));
                let legendre =
                    [x, 1.5 * x * x - 0.5, (2.5 * x * x - 1.5) * x, (4.375 * x * x - 3.75) * x * x + 0.375];
                sums.iter_mut().zip(legendre).for_each(|(sum, p)| *sum += w * v * p);
            }
        }
        features.extend(sums);
    }
    features
}

/// The environment with the power spectrum of `first` that is found from `start`, and the relative distance of both.
fn matched(first: &[Vec3], start: &[Vec3]) -> (Vec<Vec3>, f64) {
    let target = power_spectrum(first);
    let size: f64 = target.iter().map(|z| z * z).sum();
    let distance = |x: &[f64]| {
        let found = power_spectrum(x.as_chunks().0);
        found.iter().zip(&target).map(|(z, target)| (z - target).powi(2)).sum::<f64>() / size
    };
    let with_gradient = |x: &[f64], gradient: &mut [f64]| {
        for (k, derivative) in gradient.iter_mut().enumerate() {
            let at = |shift: f64| {
                let mut moved = x.to_vec();
                moved[k] += shift;
                distance(&moved)
            };
            *derivative = (at(1e-6) - at(-1e-6)) / 2e-6;
        }
        Some(distance(x))
    };
    let limits = Lbfgs { target: 1e-16, max_evaluations: 1500, reach: 0.1 };
    let found = limits.minimise(start.concat(), with_gradient, || false).unwrap();
    (found.point.as_chunks().0.to_vec(), found.value.sqrt())
}

/// The second environment of the octagon has the distances and the power spectrum of the first, and is another one.
#[test]
fn the_twin_on_the_octagon_is_found_and_is_another_environment() {
    let (first, twin) = (octagon([0, 1, 3, 4]), octagon([0, 1, 2, 5]));
    for sequence in 0..2 {
        let (found, distance) = matched(&first, &displaced(&twin, 0.05, sequence));
        let difference = EnvironmentDifference::new(&first, &found);
        assert!(distance < 1e-7 && difference.distances < 1e-3, "{distance} {difference:?}");
        assert!(difference.excludes_symmetry(0.01) && difference.spreads > 0.15, "{difference:?}");
    }
}

/// Neither a return to the first environment nor one to its mirror image is another environment.
#[test]
fn mirror_images_are_no_other_environment() {
    let first = displaced(&octagon([0, 1, 3, 4]), 0.2, 7);
    let mirrored: Vec<_> = first.iter().rev().map(|r| [-r[0], r[1], r[2]]).collect();
    for start in [&first, &mirrored] {
        let (found, distance) = matched(&first, &displaced(start, 0.01, 3));
        let difference = EnvironmentDifference::new(&first, &found);
        assert!(distance < 1e-6 && !difference.excludes_symmetry(0.01), "{distance} {difference:?}");
    }
}

/// Six neighbours have 15 degrees of freedom, the readout of this model has nine densities: its hidden layer does not determine them.
#[test]
fn another_environment_with_the_hidden_layer_of_the_first_is_found() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/data/al_eam_1l/kokkos.npz");
    let model = Arc::new(GraceModel::load(&path).unwrap());
    let allowed = AllowedDistances { closest: 1.5, farthest: 5.5 };
    let first = random_neighbours(6, 4.0, 2.2, &mut RandomSequence::new(1, 1)).unwrap();
    let species = model.elements()[0];
    let mut calculator = FeatureCalculator::of_hidden_layer(model);
    let mut matched = FeatureMatch::new(&mut calculator, species, allowed, &first).unwrap();
    let start = displaced(&first, 0.1, 1);
    let before = matched.distance(&start).unwrap();
    let limits = Lbfgs { target: 1e-18, max_evaluations: 1000, reach: 0.1 };
    let found = limits.minimise(start.concat(), |x, gradient| matched.evaluate(x, gradient), || false);
    let found: Vec<Vec3> = found.unwrap().point.as_chunks().0.to_vec();
    let after = matched.distance(&found).unwrap();
    assert!(after < 1e-2 * before, "{before} {after}");
    let difference = EnvironmentDifference::new(&first, &found);
    assert!(difference.excludes_symmetry(1e-3), "{difference:?}");
}

/// Seven neighbours have 18 directions without rotations; nine densities can change along nine of them at most.
#[test]
fn a_walk_in_the_null_space_keeps_the_hidden_layer() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/data/al_eam_1l/kokkos.npz");
    let model = Arc::new(GraceModel::load(&path).unwrap());
    let (species, max_rank) = (model.elements()[0], model.density_dimension());
    assert_eq!(max_rank, 9);
    let allowed = AllowedDistances { closest: 1.5, farthest: 5.5 };
    let first = random_neighbours(7, 4.0, 2.2, &mut RandomSequence::new(1, 2)).unwrap();
    let mut calculator = FeatureCalculator::of_hidden_layer(model);
    let mut matched = FeatureMatch::new(&mut calculator, species, allowed, &first).unwrap();
    let walk = NullSpaceWalk { target: 1e-9, farthest: 0.3, max_evaluations: 500, allowed, max_rank };
    let found = walk.run(&mut matched, &first, &mut RandomSequence::new(1, 3), || false);
    let (point, evaluations) = found.unwrap();
    let found: Vec<Vec3> = point.as_chunks().0.to_vec();
    assert!(evaluations <= 500 && matched.distance(&found).unwrap() <= 1e-9);
    let difference = EnvironmentDifference::new(&first, &found);
    assert!(difference.superposed > 0.03 && difference.excludes_symmetry(1e-3), "{difference:?}");
    assert_eq!(allowed.penalty(&found, &mut vec![[0.0; 3]; found.len()]), 0.0);
}
