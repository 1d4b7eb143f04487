//! Sums that do not depend on the order of their terms.

use serde::{Deserialize, Serialize};

use super::error::{BuildError, expect_same};

/// 2⁷⁰: the unit is 2⁻⁷⁰ ≈ 8.5·10⁻²², far below ε, the least variance of a feature. Sums reach ±2⁵⁷ ≈ 1.4·10¹⁷.
const UNITS: f64 = (1_u128 << 70) as f64;

/// 2⁵⁷, beyond which a number of units does not fit 128 bits.
const LIMIT: f64 = (1_u64 << 57) as f64;

/// Running sums in fixed point. Each term is rounded once, to 2⁻⁷⁰, and added as an integer, so the totals are the same for any
/// order and grouping of the terms. Serialisable.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ExactSums {
    units: Vec<i128>,
}

impl ExactSums {
    /// As many sums, all zero.
    pub fn new(length: usize) -> Self {
        Self { units: vec![0; length] }
    }

    /// Number of sums.
    pub fn len(&self) -> usize {
        self.units.len()
    }

    /// Whether there is no sum.
    pub fn is_empty(&self) -> bool {
        self.units.is_empty()
    }

    /// Whether a term can be added to each sum.
    ///
    /// # Errors
    /// Another number of terms, or a term or sum that is not finite or beyond ±2⁵⁷.
    pub fn check(&self, terms: &[f64]) -> Result<(), BuildError> {
        expect_same("the number of its sums", terms.len() as u64, self.len() as u64)?;
        let mut pairs = self.units.iter().zip(terms);
        pairs.try_for_each(|(&sum, &term)| checked_sum(sum, fixed(term)?).map(drop))
    }

    /// Adds a term to each sum.
    ///
    /// # Errors
    /// As [`ExactSums::check`]. Nothing is added then.
    pub fn add(&mut self, terms: &[f64]) -> Result<(), BuildError> {
        self.check(terms)?;
        self.units.iter_mut().zip(terms).for_each(|(sum, &term)| *sum += units(term));
        Ok(())
    }

    /// Adds other sums.
    ///
    /// # Errors
    /// As [`ExactSums::check`]. Nothing is added then.
    pub fn merge(&mut self, other: &Self) -> Result<(), BuildError> {
        expect_same("the number of its sums", other.len() as u64, self.len() as u64)?;
        let mut pairs = self.units.iter().zip(&other.units);
        pairs.try_for_each(|(&sum, &term)| checked_sum(sum, term).map(drop))?;
        self.units.iter_mut().zip(&other.units).for_each(|(sum, &term)| *sum += term);
        Ok(())
    }

    /// The sums, each rounded once.
    pub fn totals(&self) -> Vec<f64> {
        self.units.iter().map(|&units| to_float(units)).collect()
    }
}

fn fixed(term: f64) -> Result<i128, BuildError> {
    let fits = term.is_finite() && term.abs() < LIMIT;
    if fits { Ok(units(term)) } else { Err(BuildError::Sum { found: term }) }
}

/// A product with a power of two, which is exact but for numbers that vanish.
fn units(term: f64) -> i128 {
    (term * UNITS).round_ties_even() as i128
}

fn checked_sum(sum: i128, term: i128) -> Result<i128, BuildError> {
    sum.checked_add(term).ok_or(BuildError::Sum { found: to_float(sum) + to_float(term) })
}

fn to_float(units: i128) -> f64 {
    units as f64 / UNITS
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::build::random::Random;

    fn sums(terms: &[f64]) -> ExactSums {
        let mut sums = ExactSums::new(1);
        terms.iter().for_each(|&term| sums.add(&[term]).unwrap());
        sums
    }

    #[test]
    fn any_order_and_grouping_gives_the_same_sum() {
        let mut random = Random::new(&[3]);
        let mut terms: Vec<f64> = (0..500)
            .map(|_| (random.uniform() - 0.5) * 10_f64.powf(30.0 * random.uniform() - 18.0))
            .collect();
        let expected = sums(&terms);
        terms.sort_by(f64::total_cmp);
        let (low, high) = terms.split_at(123);
        let mut grouped = sums(high);
        grouped.merge(&sums(low)).unwrap();
        assert_eq!((sums(&terms), grouped), (expected.clone(), expected.clone()));
        // Addition in floating point loses digits to the largest terms.
        let plain: f64 = terms.iter().sum();
        assert!((expected.totals()[0] - plain).abs() <= 1e-13 * terms.iter().fold(0.0, |s, t| s + t.abs()));
        let written = through_json(&expected);
        assert_eq!(written, expected);
    }

    fn through_json(sums: &ExactSums) -> ExactSums {
        serde_json::from_slice(&serde_json::to_vec(sums).unwrap()).unwrap()
    }

    #[test]
    fn small_numbers_are_exact_and_digits_do_not_vanish() {
        let total = sums(&[1e16, 1.0, -1e16, 0.125]).totals()[0];
        assert_eq!(total, 1.125);
        assert_eq!(sums(&[3.0, -4.5]).totals(), [-1.5]);
        assert_eq!(sums(&[0.5 / UNITS, 1.5 / UNITS]).totals(), [2.0 / UNITS]);
    }

    #[test]
    fn what_does_not_fit_is_an_error_and_adds_nothing() {
        let mut sums = ExactSums::new(2);
        sums.add(&[1.0, LIMIT * 0.75]).unwrap();
        let before = sums.clone();
        for terms in [[1.0, LIMIT], [1.0, f64::NAN], [f64::INFINITY, 1.0], [-LIMIT, 1.0]] {
            assert!(matches!(sums.add(&terms), Err(BuildError::Sum { .. })), "{terms:?}");
        }
        let message = sums.add(&[1.0, LIMIT * 0.75]).unwrap_err().to_string();
        assert!(message.contains("2.1") && message.contains("sum"), "{message}");
        assert!(matches!(sums.add(&[1.0]), Err(BuildError::Partial { .. })));
        assert_eq!(sums, before);
    }
}
