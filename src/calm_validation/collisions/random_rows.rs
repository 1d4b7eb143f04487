//! The rank of many rows, from random combinations of them.

use crate::calm_validation::random::RandomSequence;
/// Singular values below this share of the largest are rounding.
const ROUNDING: f64 = 1e-10;
/// Random combinations of rows beyond the largest possible rank: with probability 1, they have the rank of all rows.
pub const SURPLUS: usize = 4;

/// Number of singular values above rounding.
pub fn rank(values: &[f64]) -> usize {
    let limit = ROUNDING * values.first().copied().unwrap_or(0.0);
    values.iter().filter(|value| **value > limit).count()
}

/// Standard normal numbers, `[count][dimension]`.
pub fn random_weights(count: usize, dimension: usize, random: &mut RandomSequence) -> Vec<Vec<f64>> {
    (0..count).map(|_| (0..dimension).map(|_| random.normal()).collect()).collect()
}
