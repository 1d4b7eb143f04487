//! Histograms.

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

/// Bins of a decade, and how many decades below the largest value have bins.
const BINS_A_DECADE: f64 = 10.0;
const DECADES: f64 = 6.0;

/// Edges 10^(k/10) round all positive values up to six decades below the largest; 1 is an edge if it is in the range. None without such
/// values.
pub fn decade_edges(values: impl Iterator<Item = f64> + Clone) -> Vec<f64> {
    let positive = values.filter(|x| *x > 0.0 && x.is_finite());
    let largest = positive.clone().fold(0.0, f64::max);
    if largest == 0.0 {
        return Vec::new();
    }
    let smallest = positive.fold(largest, f64::min).max(largest * 10_f64.powf(-DECADES));
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
        let edges = decade_edges([3.0, 0.0, 0.21, -1.0, f64::NAN].into_iter());
        let expected: Vec<_> = (-7..=5).map(|k| 10_f64.powf(f64::from(k) / 10.0)).collect();
        assert_eq!(edges, expected);
        assert!(edges[0] <= 0.21 && edges[12] >= 3.0 && edges.contains(&1.0));
        assert!(decade_edges([0.0].into_iter()).is_empty());
        // Six decades, up to rounding.
        assert!((61..=62).contains(&decade_edges([1e-9, 1.0].into_iter()).len()));
    }
}
