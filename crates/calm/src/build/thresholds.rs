//! Calibrated thresholds θ from histograms of σ.

use super::histogram::{BinEdges, Distribution, ElementHistograms, SigmaHistogram};

/// Makes the MAD of a normal distribution its standard deviation (paper, Methods).
const MAD_SCALE: f64 = 1.4826;

/// Fewest atoms for a threshold of their own, unless D is larger.
const MIN_ATOMS: usize = 50;

/// Least 99 % quantile of σ: a distribution below it is too concentrated to calibrate a threshold.
const MIN_PERCENTILE_99: f64 = 0.8;

/// The bisection for the MAD ends after this many halvings of the range of σ.
const BISECTIONS: usize = 60;

/// The threshold of a component without any data in its element.
const DEFAULT: f64 = 1.0;

/// How the threshold θ of a component follows from the distribution of σ over its training atoms.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ThresholdRule {
    /// θ = m + 3 · 1.4826 · MAD with the median m of σ and the median MAD of |σ − m| (paper, Methods).
    Robust,
    /// The quantile of σ at this percentage, above 0 and at most 100: all but 100 − Q per cent of the component's training
    /// atoms have γ ≤ 1.
    Percentile(f64),
}

impl ThresholdRule {
    /// Name in artifacts (`threshold_mode`), as the reference writes it.
    pub fn name(self) -> String {
        match self {
            Self::Robust => "robust_mad".to_owned(),
            Self::Percentile(percentage) => format!("percentile_{percentage}"),
        }
    }
}

/// Thresholds of the components of an element.
#[derive(Debug, Clone, PartialEq)]
pub struct Thresholds {
    /// From the raw histograms.
    pub raw: Vec<f64>,
    /// From the weighted histograms; these are used for grading.
    pub weighted: Vec<f64>,
}

/// What a histogram says about its threshold.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Calibration {
    threshold: f64,
    percentile_99: f64,
}

impl ElementHistograms {
    /// The threshold of each component by a rule.
    ///
    /// Quantiles come from the distribution F that is linear inside the bins; the MAD is the root of F(m + t) − F(m − t)
    /// = ½ by 60 bisections. A threshold is reliable if the component has at least max(50, D) atoms and the 99 %
    /// quantile of σ is at least 0.8. Other components get the largest reliable threshold of the element; if none is
    /// reliable, the largest of a component with data; 1 if no component has data.
    ///
    /// Weights are rounded to single precision first, as artifacts store them, so that stored histograms give the same
    /// thresholds.
    pub fn thresholds(&self, rule: ThresholdRule, dimension: usize) -> Thresholds {
        let grid = BinEdges::default();
        let raw =
            |histogram: &SigmaHistogram| histogram.raw.iter().map(|&count| count as f64).collect::<Vec<_>>();
        let weighted = |histogram: &SigmaHistogram| {
            histogram.weighted.iter().map(|&weight| f64::from(weight as f32)).collect::<Vec<_>>()
        };
        let counts: Vec<u64> = self.components.iter().map(SigmaHistogram::count).collect();
        let from = |counts_of: &dyn Fn(&SigmaHistogram) -> Vec<f64>| {
            let found: Vec<_> = self
                .components
                .iter()
                .map(|histogram| calibrate(rule, &grid, &counts_of(histogram)))
                .collect();
            with_fallback(&found, &counts, dimension)
        };
        Thresholds { raw: from(&raw), weighted: from(&weighted) }
    }
}

/// `None` without counts.
fn calibrate(rule: ThresholdRule, grid: &BinEdges, counts: &[f64]) -> Option<Calibration> {
    let distribution = Distribution::new(grid, counts)?;
    let threshold = match rule {
        ThresholdRule::Robust => robust(grid, &distribution),
        ThresholdRule::Percentile(percentage) => distribution.quantile(percentage / 100.0),
    };
    Some(Calibration { threshold, percentile_99: distribution.quantile(0.99) })
}

/// m + 3 · 1.4826 · MAD.
fn robust(grid: &BinEdges, distribution: &Distribution<'_>) -> f64 {
    let median = distribution.quantile(0.5);
    let (mut low, mut high) = (0.0, grid.edges().last().copied().unwrap_or_default());
    for _ in 0..BISECTIONS {
        let middle = 0.5 * (low + high);
        let inside = distribution.share_below(median + middle) - distribution.share_below(median - middle);
        if inside < 0.5 { low = middle } else { high = middle }
    }
    let deviation = 0.5 * (low + high);
    median + 3.0 * MAD_SCALE * deviation
}

fn with_fallback(found: &[Option<Calibration>], counts: &[u64], dimension: usize) -> Vec<f64> {
    let enough = MIN_ATOMS.max(dimension) as u64;
    let reliable = |(found, &count): (&Option<Calibration>, &u64)| {
        found.filter(|found| count >= enough && found.percentile_99 >= MIN_PERCENTILE_99).map(|f| f.threshold)
    };
    let own: Vec<Option<f64>> = found.iter().zip(counts).map(reliable).collect();
    let largest_reliable = own.iter().flatten().copied().reduce(f64::max);
    let largest = found.iter().flatten().map(|found| found.threshold).reduce(f64::max);
    let fallback = largest_reliable.or(largest).unwrap_or(DEFAULT);
    own.into_iter().map(|own| own.unwrap_or(fallback)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::build::tests::{assert_near, rows, unit_cases};

    /// The histograms of the reference's cases.
    fn histograms() -> Vec<SigmaHistogram> {
        let cases = unit_cases();
        let filled = |case: &serde_json::Value| {
            let mut histogram = SigmaHistogram::default();
            for bin in rows(&case["hist_nonzero"]) {
                histogram.raw[bin[0] as usize] = bin[1] as u64;
                histogram.weighted[bin[0] as usize] = bin[1];
            }
            histogram
        };
        cases["robust_threshold"].as_array().unwrap().iter().map(filled).collect()
    }

    #[test]
    fn thresholds_are_those_of_the_reference() {
        let (cases, grid) = (unit_cases(), BinEdges::default());
        for (case, histogram) in cases["robust_threshold"].as_array().unwrap().iter().zip(histograms()) {
            let Some(found) = calibrate(ThresholdRule::Robust, &grid, &histogram.weighted) else {
                assert!(case["threshold"].is_null());
                continue;
            };
            let expected = [case["threshold"].as_f64().unwrap(), case["p99"].as_f64().unwrap()];
            assert_near(&[found.threshold, found.percentile_99], &expected, 2e-14);
            assert_eq!(found.percentile_99 < MIN_PERCENTILE_99, case["too_concentrated"].as_bool().unwrap());
        }
    }

    #[test]
    fn unreliable_thresholds_fall_back_as_in_the_reference() {
        let case = &unit_cases()["dual_thresholds"];
        let all = histograms();
        let of = |slots: &[usize]| slots.iter().map(|&slot| all[slot].clone()).collect();
        for (element, slots) in [(0, [0, 1, 2, 3, 4]), (2, [1, 3, 2, 3, 3]), (1, [3; 5])] {
            let found = ElementHistograms { components: of(&slots) }.thresholds(ThresholdRule::Robust, 4);
            assert_near(&found.raw, &rows(&case["raw"])[element], 2e-14);
            assert_near(&found.weighted, &rows(&case["eff"])[element], 2e-14);
            // Slots with too few atoms, and those with other thresholds than their own.
            for few in rows(&case["underpopulated"]).iter().filter(|few| few[0] == element as f64) {
                let count = all[slots[few[1] as usize]].count();
                assert!(count as f64 == few[2] && count < MIN_ATOMS as u64);
            }
            for other in rows(&case["elementwise_fallback"]).iter().filter(|of| of[0] == element as f64) {
                assert_near(&[found.raw[other[1] as usize]], &[other[2]], 2e-14);
                let own = calibrate(
                    ThresholdRule::Robust,
                    &BinEdges::default(),
                    &all[slots[other[1] as usize]].weighted,
                );
                assert!(own.is_none_or(|own| own.threshold != other[2]));
            }
        }
        assert_eq!(case["min_atoms"], MIN_ATOMS);
        // 200 atoms are too few for more features.
        let found = ElementHistograms { components: of(&[0, 4]) }.thresholds(ThresholdRule::Robust, 201);
        assert_eq!(found.raw[0], found.raw[1]);
    }
}
