//! Error statistics by bins of a score, for many resamplings of the same items.

use crate::Bins;
use crate::quantiles::quantile_by_index;

/// Items sorted once by bin and error. The statistics of a resampling then cost one pass over the items.
#[derive(Clone, Debug)]
pub struct BinnedErrors(Vec<SortedBin>);

/// The items of a bin by ascending error.
#[derive(Clone, Debug)]
struct SortedBin {
    errors: Vec<f64>,
    /// The unit of each item.
    units: Vec<u32>,
    /// Number of items whose error is not above the threshold.
    small: usize,
}

/// Errors of a bin; `None` in an empty one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BinStatistics {
    /// Median, see [`crate::quantile`].
    pub median: Option<f64>,
    /// 90 % quantile.
    pub p90: Option<f64>,
    /// Fraction of the errors above the threshold.
    pub large: Option<f64>,
}

impl BinnedErrors {
    /// Items (score, error, unit) in bins of the score. Errors above `threshold` count as large.
    pub fn new(bins: &Bins, threshold: f64, items: impl IntoIterator<Item = (f64, f64, u32)>) -> Self {
        let mut of_bins = vec![Vec::new(); bins.count()];
        for (score, error, unit) in items {
            of_bins[bins.index_of(score)].push((error, unit));
        }
        let sorted = |mut items: Vec<(f64, u32)>| {
            items.sort_by(|(a, _), (b, _)| a.total_cmp(b));
            let (errors, units): (Vec<f64>, Vec<u32>) = items.into_iter().unzip();
            SortedBin { small: errors.partition_point(|error| *error <= threshold), errors, units }
        };
        Self(of_bins.into_iter().map(sorted).collect())
    }

    /// The statistics of each bin if every item of unit u is there `multiplicities[u]` times.
    ///
    /// # Panics
    /// If a unit has no multiplicity.
    pub fn statistics(&self, multiplicities: &[u32]) -> Vec<BinStatistics> {
        self.0.iter().map(|bin| bin.statistics(multiplicities)).collect()
    }
}

impl SortedBin {
    fn statistics(&self, multiplicities: &[u32]) -> BinStatistics {
        // Of each item: how many there are up to it, repetitions included.
        let ends = self.units.iter().scan(0, |end, unit| {
            *end += multiplicities[*unit as usize] as usize;
            Some(*end)
        });
        let ends: Vec<usize> = ends.collect();
        let total = ends.last().copied().unwrap_or(0);
        let small = self.small.checked_sub(1).map_or(0, |last| ends[last]);
        let error = |place: usize| self.errors[ends.partition_point(|end| *end <= place)];
        BinStatistics {
            median: quantile_by_index(total, 0.5, error),
            p90: quantile_by_index(total, 0.9, error),
            large: (total > 0).then(|| (total - small) as f64 / total as f64),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::ForceErrors;

    proptest! {
        /// Statistics with multiplicities are those of the list in which every item is repeated.
        #[test]
        fn multiplicities_repeat_items(
            items in prop::collection::vec((0_u8..30, 0_u8..12, 0_u32..6), 0..80),
            counts in prop::collection::vec(0_u32..4, 6)
        ) {
            let items = items.iter().map(|(score, error, unit)| {
                (0.1 * f64::from(*score), 0.25 * f64::from(*error), *unit)
            });
            let items: Vec<_> = items.collect();
            let binned = BinnedErrors::new(&Bins::for_grades(), 1.0, items.iter().copied());
            let mut repeated = ForceErrors::new(Bins::for_grades(), 1.0, 1000);
            for (score, error, unit) in items {
                (0..counts[unit as usize]).for_each(|_| repeated.add(score, error));
            }
            let bins = repeated.bins().into_iter();
            let expected = bins.map(|bin| BinStatistics { median: bin.median, p90: bin.p90, large: bin.large });
            prop_assert_eq!(binned.statistics(&counts), expected.collect::<Vec<_>>());
        }
    }
}
