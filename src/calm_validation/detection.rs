//! Whether a score detects compression and stretching along a bond scan.

use serde::Serialize;

/// Compression is shorter than this, in distances of equilibrium.
pub const COMPRESSION: f64 = 0.8;
/// Stretching is longer than this, in distances of equilibrium, and shorter than [`LONGEST`].
pub const STRETCHING: f64 = 1.4;
/// Å.
pub const LONGEST: f64 = 6.0;
/// Distances this close to equilibrium, relative to it, are near it.
const NEAR: f64 = 0.05;

/// When a score detects a regime (paper, 'Validation models, datasets and metrics').
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DetectionRule {
    /// Its largest value is above this.
    Threshold(f64),
    /// Its largest value is above this multiple of the median within 5 % of equilibrium.
    TimesMedian(f64),
}

impl DetectionRule {
    /// That of scores without a threshold.
    pub const TENFOLD: Self = Self::TimesMedian(10.0);
}

/// Which regimes of a bond scan a score detects. Values are `None` where the scan has no distance of that regime.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Detection {
    /// Compression is detected.
    pub compression: Option<bool>,
    /// Stretching is detected.
    pub stretching: Option<bool>,
    /// The crystal at equilibrium is not detected.
    pub interpolation: Option<bool>,
    /// The largest value under compression.
    pub largest_in_compression: Option<f64>,
    /// The largest value under stretching.
    pub largest_in_stretching: Option<f64>,
    /// The value at equilibrium.
    pub at_equilibrium: Option<f64>,
    /// The median within 5 % of equilibrium.
    pub median_near_equilibrium: Option<f64>,
}

/// Applies the rule to a scan of distances, Å, and scores. `at_equilibrium` is the score there. `None` where a structure could not be
/// scored.
pub fn detect(
    scan: &[(f64, Option<f64>)],
    equilibrium: f64,
    at_equilibrium: Option<f64>,
    rule: Option<DetectionRule>,
) -> Detection {
    let within = |is_inside: &dyn Fn(f64) -> bool| -> Vec<f64> {
        scan.iter().filter(|(d, _)| is_inside(*d)).filter_map(|(_, score)| *score).collect()
    };
    let largest = |values: &[f64]| values.iter().copied().reduce(f64::max);
    let compressed = largest(&within(&|d| d < COMPRESSION * equilibrium));
    let stretched = largest(&within(&|d| d > STRETCHING * equilibrium && d < LONGEST));
    let mut near = within(&|d| (d / equilibrium - 1.0).abs() <= NEAR);
    near.sort_by(f64::total_cmp);
    let median = analysis::quantile(&near, 0.5);
    let limit = match rule {
        Some(DetectionRule::Threshold(limit)) => Some(limit),
        // A score may be infinite for all atoms of an element, which tells nothing.
        Some(DetectionRule::TimesMedian(factor)) => {
            median.map(|median| factor * median).filter(|limit| limit.is_finite())
        }
        None => None,
    };
    let is_above = |value: Option<f64>| value.zip(limit).map(|(value, limit)| value > limit);
    Detection {
        compression: is_above(compressed),
        stretching: is_above(stretched),
        interpolation: is_above(at_equilibrium).map(|above| !above),
        largest_in_compression: compressed,
        largest_in_stretching: stretched,
        at_equilibrium,
        median_near_equilibrium: median,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A scan from 1.5 to 6 Å in steps of 0.1 Å.
    fn scan(score: impl Fn(f64) -> Option<f64>) -> Vec<(f64, Option<f64>)> {
        (0..=45).map(|k| 1.5 + 0.1 * f64::from(k)).map(|d| (d, score(d))).collect()
    }

    fn verdicts(score: impl Fn(f64) -> Option<f64>, rule: DetectionRule) -> [Option<bool>; 3] {
        let found = detect(&scan(&score), 2.5, score(2.5), Some(rule));
        [found.compression, found.interpolation, found.stretching]
    }

    #[test]
    fn a_score_without_finite_values_decides_nothing() {
        assert_eq!(verdicts(|_| Some(f64::INFINITY), DetectionRule::TENFOLD), [None; 3]);
        assert_eq!(
            verdicts(|_| Some(f64::INFINITY), DetectionRule::Threshold(1.0)),
            [Some(true), Some(false), Some(true)]
        );
    }

    #[test]
    fn regimes_are_where_the_paper_says() {
        let rule = DetectionRule::Threshold(1.0);
        let valley = |d: f64| Some(0.5 + 2.0 * (d - 2.5).abs());
        assert_eq!(verdicts(valley, rule), [Some(true); 3]);
        // Compression is below 2.0 Å, stretching above 3.5 Å and below 6 Å.
        let only = |low: f64, high: f64| move |d: f64| Some(if d > low && d < high { 2.0 } else { 0.1 });
        assert_eq!(verdicts(only(1.4, 1.55), rule), [Some(true), Some(true), Some(false)]);
        assert_eq!(verdicts(only(2.05, 2.3), rule), [Some(false), Some(true), Some(false)]);
        assert_eq!(verdicts(only(2.45, 2.55), rule), [Some(false), Some(false), Some(false)]);
        assert_eq!(verdicts(only(2.75, 3.45), rule), [Some(false), Some(true), Some(false)]);
        assert_eq!(verdicts(only(3.55, 3.65), rule), [Some(false), Some(true), Some(true)]);
        assert_eq!(verdicts(only(5.95, 7.0), rule), [Some(false), Some(true), Some(false)]);
        // Exactly 1 is inside.
        assert_eq!(verdicts(|_| Some(1.0), rule), [Some(false), Some(true), Some(false)]);
    }

    #[test]
    fn a_spread_is_compared_with_its_own_median() {
        let rule = DetectionRule::TimesMedian(10.0);
        let rising = |factor: f64| move |d: f64| Some(if d > 3.5 { 0.01 * factor } else { 0.01 });
        assert_eq!(verdicts(rising(9.9), rule)[2], Some(false));
        assert_eq!(verdicts(rising(10.1), rule)[2], Some(true));
    }

    #[test]
    fn what_is_not_in_the_scan_is_unknown() {
        let found = detect(&scan(|_| Some(2.0)), 1.6, None, Some(DetectionRule::Threshold(1.0)));
        assert_eq!((found.compression, found.stretching), (None, Some(true)));
        let found = detect(&scan(|_| Some(2.0)), 5.0, None, Some(DetectionRule::Threshold(1.0)));
        assert_eq!((found.compression, found.stretching), (Some(true), None));
        let found =
            detect(&scan(|d| (d > 2.0).then_some(2.0)), 2.5, None, Some(DetectionRule::Threshold(1.0)));
        assert_eq!((found.compression, found.largest_in_compression), (None, None));
        let found = detect(&scan(|_| Some(2.0)), 2.5, None, None);
        assert_eq!((found.compression, found.largest_in_compression), (None, Some(2.0)));
    }
}
