//! A walk of the neighbours of an atom that keeps its features: along directions that the Jacobian maps to zero, and back onto the features by
//! Gauss–Newton steps (paper, SI1).

use analysis::{RowSpace, singular_values};
use atoms::Vec3;
use atoms::cell::cross;

use super::environments::EnvironmentDifference;
use super::feature_match::{AllowedDistances, FeatureMatch};
use super::random_rows::{SURPLUS, random_weights, rank};
use crate::calm_validation::random::RandomSequence;

/// Root mean square path of a neighbour in a step, Å.
const STEP: f64 = 0.05;
/// Gauss–Newton steps with one Jacobian.
const CORRECTIONS: usize = 12;
/// Times that a step is turned away from distances that are not allowed, or halved.
const TRIES: usize = 12;

/// How far a walk goes.
#[derive(Clone, Copy, Debug)]
pub struct NullSpaceWalk {
    /// Relative distance of the features that it keeps.
    pub target: f64,
    /// It ends when the environment has moved so far, Å: root mean square after superposition …
    pub farthest: f64,
    /// … or after so many evaluations of the features or of a row of their Jacobian.
    pub max_evaluations: usize,
    /// Distances that it keeps.
    pub allowed: AllowedDistances,
    /// Largest possible rank of the Jacobian: the number of densities for the hidden layer.
    pub max_rank: usize,
}

/// The features, random combinations of them, and what was evaluated.
struct WalkedFeatures<'a, 'b> {
    matched: &'a mut FeatureMatch<'b>,
    /// As many as the Jacobian has rank, `[rank][D]`: what they keep, all features keep.
    weights: Vec<Vec<f64>>,
    evaluations: usize,
}

impl NullSpaceWalk {
    /// Walks from the environment whose features are matched. Returns the coordinates of the neighbours and the evaluations; `None` if
    /// there is no step that keeps features and distances.
    pub fn run(
        &self,
        matched: &mut FeatureMatch<'_>,
        start: &[Vec3],
        random: &mut RandomSequence,
        stop: impl Fn() -> bool,
    ) -> Option<(Vec<f64>, usize)> {
        matched.deviations(start)?;
        let mut weights = random_weights(self.max_rank + SURPLUS, matched.dimension(), random);
        let columns = 3 * start.len();
        let values = singular_values(&matched.combined_gradients(&weights)?, columns)?;
        let evaluations = 1 + weights.len();
        weights.truncate(rank(&values));
        let mut features = WalkedFeatures { matched, weights, evaluations };
        let (mut point, mut has_moved) = (start.concat(), false);
        let mut direction: Vec<f64> = (0..columns).map(|_| random.normal()).collect();
        while features.evaluations + features.weights.len() < self.max_evaluations && !stop() {
            let Some(next) = self.step(&mut features, &point, &mut direction) else { break };
            (point, has_moved) = (next, true);
            let (neighbours, _) = point.as_chunks::<3>();
            if EnvironmentDifference::new(start, neighbours).superposed >= self.farthest {
                break;
            }
        }
        has_moved.then_some((point, features.evaluations))
    }

    /// A step from `point`, which was evaluated last, along `direction`, which is turned as needed. The result is evaluated last.
    fn step(
        &self,
        features: &mut WalkedFeatures<'_, '_>,
        point: &[f64],
        direction: &mut Vec<f64>,
    ) -> Option<Vec<f64>> {
        let columns = point.len();
        let rows = features.matched.combined_gradients(&features.weights)?;
        features.evaluations += features.weights.len();
        let changing = RowSpace::new(&rows, columns)?;
        let rigid_too = RowSpace::new(&[rows, rotations(point)].concat(), columns)?;
        let mut length = STEP * (columns as f64 / 3.0).sqrt();
        for _ in 0..TRIES {
            rigid_too.remove_from(direction);
            let factor = length / norm(direction);
            if !factor.is_finite() {
                return None;
            }
            let moved = point.iter().zip(&*direction).map(|(x, d)| x + factor * d).collect();
            let Some(found) = self.corrected(features, &changing, moved) else {
                length *= 0.5;
                continue;
            };
            let (mut away, (neighbours, _)) = (vec![0.0; columns], found.as_chunks::<3>());
            if self.allowed.penalty(neighbours, away.as_chunks_mut().0) == 0.0 {
                *direction = found.iter().zip(point).map(|(new, old)| new - old).collect();
                return Some(found);
            }
            rigid_too.remove_from(&mut away);
            reflect(direction, &away);
        }
        None
    }

    /// Moves `point` until it has the features again. `None` if it does not come closer to them.
    fn corrected(
        &self,
        features: &mut WalkedFeatures<'_, '_>,
        changing: &RowSpace,
        mut point: Vec<f64>,
    ) -> Option<Vec<f64>> {
        let mut last = f64::INFINITY;
        for _ in 0..CORRECTIONS {
            if features.evaluations >= self.max_evaluations {
                return None;
            }
            features.evaluations += 1;
            let (neighbours, _) = point.as_chunks::<3>();
            let deviations = features.matched.deviations(neighbours)?;
            let distance = features.matched.relative(&deviations);
            if distance <= self.target {
                return Some(point);
            }
            let is_closer = distance < last;
            if !is_closer {
                return None;
            }
            last = distance;
            let combined = features.weights.iter().map(|weights| -dot(weights, &deviations));
            let change = changing.solve(&combined.collect::<Vec<_>>());
            point.iter_mut().zip(change).for_each(|(x, change)| *x += change);
        }
        None
    }
}

/// Changes of the coordinates when the neighbours are turned about each axis, `[3 × 3m]`.
fn rotations(point: &[f64]) -> Vec<f64> {
    let (neighbours, _) = point.as_chunks::<3>();
    let axes: [Vec3; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    axes.iter().flat_map(|axis| neighbours.iter().flat_map(|r| cross(*axis, *r))).collect()
}

/// Turns a direction away from another one, as a wall does.
fn reflect(direction: &mut [f64], away: &[f64]) {
    let factor = 2.0 * dot(direction, away).abs() / dot(away, away);
    if factor.is_finite() {
        direction.iter_mut().zip(away).for_each(|(d, away)| *d -= factor * away);
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn norm(a: &[f64]) -> f64 {
    dot(a, a).sqrt()
}
