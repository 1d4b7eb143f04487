//! Histograms.

use std::ops::RangeInclusive;

use crate::quantiles::quantile;

/// Counts values between ascending edges. A bin includes its lower edge; the last bin also includes its upper
/// edge.
#[derive(Clone, Debug, PartialEq)]
pub struct Histogram {
    edges: Vec<f64>,
    counts: Vec<u64>,
    outside: u64,
}

impl Histogram {
    /// An empty histogram with these edges.
    ///
    /// # Panics
    /// If there are fewer than two edges or they do not ascend, which is a bug of the caller.
    pub fn new(edges: Vec<f64>) -> Self {
        assert!(edges.len() > 1 && edges.is_sorted_by(|a, b| a < b), "edges ascend");
        let counts = vec![0; edges.len() - 1];
        Self { edges, counts, outside: 0 }
    }

    /// The histogram of these values.
    pub fn from_values(edges: Vec<f64>, values: impl IntoIterator<Item = f64>) -> Self {
        let mut histogram = Self::new(edges);
        values.into_iter().for_each(|value| histogram.add(value));
        histogram
    }

    /// Counts a value.
    pub fn add(&mut self, value: f64) {
        match bin_index(&self.edges, value) {
            Some(index) => self.counts[index] += 1,
            None => self.outside += 1,
        }
    }

    /// The edges, one more than there are bins.
    pub fn edges(&self) -> &[f64] {
        &self.edges
    }

    /// Counts by bin.
    pub fn counts(&self) -> &[u64] {
        &self.counts
    }

    /// Number of values outside all bins.
    pub fn outside(&self) -> u64 {
        self.outside
    }

    /// Fraction of all values in each bin, including values outside in the total.
    pub fn fractions(&self) -> Vec<f64> {
        let all = self.outside + self.counts.iter().sum::<u64>();
        self.counts.iter().map(|count| *count as f64 / all.max(1) as f64).collect()
    }
}

/// Index of the bin that holds a value: bins include their lower edge, the last bin both edges.
pub(crate) fn bin_index(edges: &[f64], value: f64) -> Option<usize> {
    let bins = edges.len().checked_sub(1)?;
    if value.is_nan() || value < edges[0] || value > edges[bins] {
        return None;
    }
    Some((edges.partition_point(|edge| *edge <= value) - 1).min(bins - 1))
}

/// Edges of `bins` bins of equal width.
pub fn linear_edges(low: f64, high: f64, bins: usize) -> Vec<f64> {
    (0..=bins).map(|k| low + (high - low) * k as f64 / bins as f64).collect()
}

/// Edges of `bins` bins of equal width on a logarithmic scale; `low` and `high` must be positive.
pub fn logarithmic_edges(low: f64, high: f64, bins: usize) -> Vec<f64> {
    linear_edges(low.ln(), high.ln(), bins).into_iter().map(f64::exp).collect()
}

/// Bins of a decade.
const BINS_A_DECADE: f64 = 10.0;
/// Shares of the largest value and of the median down to which values have bins: six and three decades below them.
const OF_LARGEST: f64 = 1e-6;
const OF_MEDIAN: f64 = 1e-3;
/// Values that can have bins: near the ends of double precision, edges would coincide or be infinite.
const BINNED: RangeInclusive<f64> = 1e-300..=1e300;

/// Edges 10^(k/10) round all positive values; 1 is an edge if it is in the range. Values are left out if they are six decades below the
/// largest, three decades below the median, and below `reached`: a few large values do not leave out the others, and what is zero up to
/// rounding does not stretch the range. None without positive values.
pub fn decade_edges(values: impl Iterator<Item = f64>, reached: Option<f64>) -> Vec<f64> {
    let mut positive: Vec<_> = values.filter(|x| BINNED.contains(x)).collect();
    positive.sort_by(f64::total_cmp);
    let (Some(&smallest), Some(&largest)) = (positive.first(), positive.last()) else {
        return Vec::new();
    };
    let median = quantile(&positive, 0.5).unwrap_or(largest);
    let lowest = (OF_LARGEST * largest).min(OF_MEDIAN * median).min(reached.unwrap_or(f64::INFINITY));
    let smallest = smallest.max(lowest);
    let last = (largest.log10() * BINS_A_DECADE).ceil() as i32;
    let first = ((smallest.log10() * BINS_A_DECADE).floor() as i32).min(last - 1);
    (first..=last).map(|k| 10_f64.powf(f64::from(k) / BINS_A_DECADE)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_bin_has_its_lower_edge() {
        let values = [0.0, 0.9, 1.0, 2.9, 3.0, 3.1, -0.1, f64::NAN];
        let histogram = Histogram::from_values(linear_edges(0.0, 3.0, 3), values);
        assert_eq!((histogram.counts(), histogram.outside()), (&[2, 1, 2][..], 3));
        assert_eq!(histogram.fractions(), [0.25, 0.125, 0.25]);
        assert_eq!(Histogram::new(vec![0.0, 1.0]).fractions(), [0.0]);
    }

    #[test]
    fn logarithmic_bins_have_one_ratio() {
        let edges = logarithmic_edges(0.01, 100.0, 4);
        for (edge, expected) in edges.iter().zip([0.01, 0.1, 1.0, 10.0, 100.0]) {
            assert!((edge / expected - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn decades_have_ten_bins() {
        let edges = decade_edges([3.0, 0.0, 0.21, -1.0, f64::NAN].into_iter(), None);
        let expected: Vec<_> = (-7..=5).map(|k| 10_f64.powf(f64::from(k) / 10.0)).collect();
        assert_eq!(edges, expected);
        assert!(edges[0] <= 0.21 && edges[12] >= 3.0 && edges.contains(&1.0));
        assert!(decade_edges([0.0].into_iter(), None).is_empty());
        // Six decades, up to rounding.
        assert!((61..=62).contains(&decade_edges([1e-9, 1.0].into_iter(), None).len()));
    }

    #[test]
    fn decades_of_a_heavy_tail_reach_the_others() {
        let lowest = |values: &[f64], reached| decade_edges(values.iter().copied(), reached)[0];
        // Three decades below the median of 0.3.
        assert!(lowest(&[0.2, 0.3, 1e9], None) <= 0.2);
        assert!((lowest(&[1e-17, 0.3, 1e9], None) / 2.512e-4 - 1.0).abs() < 1e-3);
        let tail = [0.05, 1e8, 1e9, 1e9];
        assert!((790.0..1001.0).contains(&lowest(&tail, None)));
        assert!((0.079..0.1001).contains(&lowest(&tail, Some(0.1))));
        // All edges can be told apart, and are finite.
        let edges = decade_edges([5e-324, 1e-300, f64::MAX, 1e299].into_iter(), Some(0.0));
        assert!(edges.is_sorted_by(|a, b| a < b) && edges.iter().all(|edge| edge.is_finite()));
    }
}
