//! Tests of paired differences: Wilcoxon's signed-rank test and the sign test.

use crate::normal_tail::two_sided_normal_tail;

/// Largest number of differences without ties whose distribution is counted exactly.
const MAX_EXACT: usize = 50;

/// Wilcoxon's signed-rank test of the hypothesis that differences are distributed symmetrically about zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SignedRankTest {
    /// Differences that are not zero. The others take no part.
    pub differences: usize,
    /// Sum of the ranks of the positive differences, by magnitude.
    pub positive_ranks: f64,
    /// Sum of the ranks of the negative ones.
    pub negative_ranks: f64,
    /// Two-sided probability of rank sums at least as unequal.
    pub p_value: f64,
    /// Whether the probability is counted over all signs, and not from the normal distribution.
    pub is_exact: bool,
}

/// The sign test of the hypothesis that a difference is positive or negative with the same probability.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SignTest {
    /// Number of positive differences.
    pub positive: u64,
    /// Number of negative ones. Differences of zero take no part.
    pub negative: u64,
    /// Two-sided probability of numbers at least as unequal, from the binomial distribution.
    pub p_value: f64,
}

impl SignedRankTest {
    /// Tests differences, which must be finite. `None` without a difference other than zero.
    ///
    /// Zeros are left out (Wilcoxon's own treatment; `zero_method="wilcox"` of SciPy), and equal magnitudes share their mean rank.
    /// Up to 50 differences without ties, the probability is exact. Beyond that, or with ties, it is that of the
    /// normal distribution with the variance n(n + 1)(2n + 1)/24 − Σ(t³ − t)/48 over groups of t equal magnitudes
    /// (Hollander, Wolfe & Chicken, Nonparametric Statistical Methods (2014), section 3.1), without a correction for continuity.
    pub fn new(differences: &[f64]) -> Option<Self> {
        let mut ordered: Vec<f64> = differences.iter().copied().filter(|x| *x != 0.0).collect();
        ordered.sort_by(|a, b| a.abs().total_cmp(&b.abs()));
        let number = ordered.len();
        if number == 0 {
            return None;
        }
        let (mut positive_ranks, mut tied, mut before) = (0.0, 0.0, 0);
        for run in ordered.chunk_by(|a, b| a.abs() == b.abs()) {
            let rank = before as f64 + 0.5 * (run.len() + 1) as f64;
            positive_ranks += rank * run.iter().filter(|x| **x > 0.0).count() as f64;
            let t = run.len() as f64;
            tied += t * t * t - t;
            before += run.len();
        }
        let n = number as f64;
        let is_exact = number <= MAX_EXACT && tied == 0.0;
        let p_value = match is_exact {
            true => exact_probability(number, positive_ranks),
            false => {
                let variance = n * (n + 1.0) * (2.0 * n + 1.0) / 24.0 - tied / 48.0;
                two_sided_normal_tail((positive_ranks - 0.25 * n * (n + 1.0)) / variance.sqrt())
            }
        };
        let negative_ranks = 0.5 * n * (n + 1.0) - positive_ranks;
        Some(Self { differences: number, positive_ranks, negative_ranks, p_value, is_exact })
    }
}

/// Two-sided probability of a sum of positive ranks this far from the mean, when each rank from 1 to `number` is positive with
/// probability ½.
fn exact_probability(number: usize, positive_ranks: f64) -> f64 {
    let largest = number * (number + 1) / 2;
    // Number of sets of ranks with each sum. Below 2⁵³, so it has no rounding.
    let mut sets = vec![0.0; largest + 1];
    sets[0] = 1.0;
    for rank in 1..=number {
        (rank..=largest).rev().for_each(|sum| sets[sum] += sets[sum - rank]);
    }
    // The distribution is symmetric.
    let smaller = positive_ranks.min(largest as f64 - positive_ranks) as usize;
    let tail: f64 = sets[..=smaller].iter().sum();
    (2.0 * tail / 2_f64.powi(number as i32)).min(1.0)
}

impl SignTest {
    /// Tests differences. `None` without a difference other than zero.
    pub fn new(differences: &[f64]) -> Option<Self> {
        let count = |test: fn(&f64) -> bool| differences.iter().copied().filter(test).count() as u64;
        let (positive, negative) = (count(|x| *x > 0.0), count(|x| *x < 0.0));
        let p_value = sign_probability(positive.min(negative), positive + negative);
        (positive + negative > 0).then_some(Self { positive, negative, p_value })
    }
}

/// min(1, 2 P(X ≤ k)) of a binomial X over n trials with probability ½.
fn sign_probability(k: u64, n: u64) -> f64 {
    let (k, n) = (k as f64, n as f64);
    // The largest term as a logarithm: n may be large.
    let mut logarithm = -n * std::f64::consts::LN_2;
    let mut i = 0.0;
    while i < k {
        logarithm += ((n - i) / (i + 1.0)).ln();
        i += 1.0;
    }
    let (mut term, mut sum) = (1.0, 1.0);
    while i > 0.0 && term > f64::EPSILON * 0.01 {
        term *= i / (n - i + 1.0);
        sum += term;
        i -= 1.0;
    }
    (2.0 * logarithm.exp() * sum).min(1.0)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn near(found: f64, expected: f64) {
        assert!((found / expected - 1.0).abs() < 1e-10, "{found} is not {expected}");
    }

    /// scipy.stats.wilcoxon(d, zero_method="wilcox", method="exact" or "asymptotic", correction=False), SciPy 1.17.
    #[test]
    fn probabilities_are_those_of_scipy() {
        // Depression scores of Hollander and Wolfe's table 3.1.
        let scores = [0.952, -0.147, 1.022, 0.43, 0.62, 0.59, 0.49, -0.08, 0.01];
        let found = SignedRankTest::new(&scores).unwrap();
        assert_eq!((found.differences, found.positive_ranks, found.negative_ranks), (9, 40.0, 5.0));
        assert!(found.is_exact);
        near(found.p_value, 0.0390625);
        // Zeros are left out, and ties take the normal distribution.
        let tied = [0.0, 1.0, 1.0, -1.0, 2.0, 3.0, -2.0, 0.0, 4.0, 5.0, -3.0, 2.0, 6.0, 7.0, 1.0];
        let found = SignedRankTest::new(&tied).unwrap();
        assert_eq!((found.differences, found.negative_ranks, found.is_exact), (13, 17.0, false));
        near(found.p_value, 0.04540058063513438);
        let waves: Vec<_> = (0..60).map(|k| (1.0 + 2.3 * f64::from(k)).sin() + 0.25).collect();
        for (number, smaller, is_exact, expected) in [
            (20, 60.0, true, 0.09730720520019531),
            (50, 384.0, true, 0.013686934524772099),
            (60, 567.0, false, 0.010411991904238317),
        ] {
            let found = SignedRankTest::new(&waves[..number]).unwrap();
            assert_eq!((found.negative_ranks, found.is_exact), (smaller, is_exact));
            near(found.p_value, expected);
        }
        assert_eq!(SignedRankTest::new(&[0.0, -0.0]), None);
    }

    /// scipy.stats.binomtest(k, n, 0.5).pvalue, SciPy 1.17.
    #[test]
    fn sign_tests_are_those_of_scipy() {
        for (k, n, expected) in [
            (8, 9, 0.0390625),
            (60, 71, 2.633328534504438e-9),
            (35, 71, 1.0),
            (0, 5, 0.0625),
            (5200, 10_000, 6.593515598672343e-5),
        ] {
            let differences: Vec<_> = (0..n).map(|i| if i < k { 1.0 } else { -2.0 }).collect();
            let found = SignTest::new(&differences).unwrap();
            assert_eq!((found.positive, found.negative), (k, n - k));
            near(found.p_value, expected);
        }
        assert_eq!(SignTest::new(&[0.0]), None);
    }

    proptest! {
        /// The exact probability is that of counting all signs, and neither the order nor the sign of all matters.
        #[test]
        fn exact_probabilities_count_signs(signs in prop::collection::vec(any::<bool>(), 1..12)) {
            let differences: Vec<_> =
                signs.iter().zip(1..).map(|(sign, k)| if *sign { f64::from(k) } else { -f64::from(k) }).collect();
            let found = SignedRankTest::new(&differences).unwrap();
            let n = signs.len();
            let away = |sum: usize| (2 * sum).abs_diff(n * (n + 1) / 2);
            let sum = |set: usize| -> usize { (0..n).filter(|k| set >> k & 1 == 1).map(|k| k + 1).sum() };
            let far = (0..1 << n).filter(|set| away(sum(*set)) >= away(found.positive_ranks as usize)).count();
            prop_assert!((found.p_value - far as f64 / 2_f64.powi(n as i32)).abs() < 1e-12);
            let opposite: Vec<_> = differences.iter().rev().map(|x| -x).collect();
            let mirrored = SignedRankTest::new(&opposite).unwrap();
            prop_assert!((mirrored.p_value - found.p_value).abs() < 1e-14);
            prop_assert_eq!(mirrored.positive_ranks, found.negative_ranks);
        }
    }
}
