//! How often errors exceed thresholds, with and without a filter.

/// Counts of the errors above each of a list of thresholds: of all items, and of those that a filter keeps, such as the
/// atoms with γ ≤ 1. Contamination is the probability that a kept item has an error above a threshold, retention the
/// share of items that is kept (paper, SI, contamination curves).
#[derive(Clone, Debug, PartialEq)]
pub struct Exceedance {
    thresholds: Vec<f64>,
    /// Counts of errors by the number of thresholds below them.
    all: Vec<u64>,
    kept: Vec<u64>,
}

impl Exceedance {
    /// No items yet.
    ///
    /// # Panics
    /// If the thresholds do not ascend, which is a bug of the caller.
    pub fn new(thresholds: &[f64]) -> Self {
        assert!(thresholds.is_sorted_by(|a, b| a < b), "thresholds ascend");
        let counts = vec![0; thresholds.len() + 1];
        Self { thresholds: thresholds.to_vec(), all: counts.clone(), kept: counts }
    }

    /// Adds an item, `times` times.
    pub fn add(&mut self, error: f64, is_kept: bool, times: u32) {
        self.add_to_bin(self.bin_index(error), is_kept, times);
    }

    /// The number of thresholds that this error exceeds.
    pub fn bin_index(&self, error: f64) -> usize {
        self.thresholds.partition_point(|threshold| *threshold < error)
    }

    /// As [`Self::add`], with the error's [`Self::bin_index`].
    pub fn add_to_bin(&mut self, bin: usize, is_kept: bool, times: u32) {
        self.all[bin] += u64::from(times);
        self.kept[bin] += u64::from(times) * u64::from(is_kept);
    }

    /// Share of all items that is kept; `None` without items.
    pub fn retention(&self) -> Option<f64> {
        share(self.kept.iter().sum(), self.all.iter().sum())
    }

    /// Share of the kept items with an error above each threshold; `None` if none is kept.
    pub fn contamination(&self) -> Vec<Option<f64>> {
        above(&self.kept)
    }

    /// Share of all items with an error above each threshold.
    pub fn unfiltered(&self) -> Vec<Option<f64>> {
        above(&self.all)
    }
}

fn above(counts: &[u64]) -> Vec<Option<f64>> {
    let total = counts.iter().sum();
    (1..counts.len()).map(|first| share(counts[first..].iter().sum(), total)).collect()
}

fn share(part: u64, of: u64) -> Option<f64> {
    (of > 0).then(|| part as f64 / of as f64)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn an_error_at_a_threshold_is_not_above_it() {
        let mut counts = Exceedance::new(&[0.5, 1.0]);
        assert_eq!((counts.retention(), counts.contamination()), (None, vec![None; 2]));
        for (error, is_kept) in [(0.1, true), (0.5, true), (0.7, true), (1.0, false), (2.0, false)] {
            counts.add(error, is_kept, 2);
        }
        assert_eq!(counts.retention(), Some(0.6));
        assert_eq!(counts.contamination(), [Some(1.0 / 3.0), Some(0.0)]);
        assert_eq!(counts.unfiltered(), [Some(0.6), Some(0.2)]);
    }

    proptest! {
        /// Errors above a threshold are kept or not: P(above) = P(above | kept) P(kept) + P(above | not kept) P(not kept).
        #[test]
        fn contamination_and_retention_add_up(items in prop::collection::vec((0.0..3.0, any::<bool>(), 0_u32..4), 1..80)) {
            let thresholds = [0.2, 0.5, 1.0, 2.5];
            let (mut kept, mut dropped) = (Exceedance::new(&thresholds), Exceedance::new(&thresholds));
            for (error, is_kept, times) in items {
                kept.add(error, is_kept, times);
                dropped.add(error, !is_kept, times);
            }
            prop_assert_eq!(kept.unfiltered(), dropped.unfiltered());
            let Some(retention) = kept.retention() else { return Ok(()) };
            let rest = dropped.retention().unwrap();
            prop_assert!((retention + rest - 1.0).abs() < 1e-12);
            for k in 0..thresholds.len() {
                let part = |of: &Exceedance, share: f64| of.contamination()[k].map_or(0.0, |of| of * share);
                let sum = part(&kept, retention) + part(&dropped, rest);
                prop_assert!((sum - kept.unfiltered()[k].unwrap()).abs() < 1e-12);
            }
            prop_assert!(kept.contamination().is_sorted_by(|a, b| a >= b));
        }
    }
}
