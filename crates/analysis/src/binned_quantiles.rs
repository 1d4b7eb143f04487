//! Quantiles of one quantity in bins of another.

use crate::histogram::bin_index;
use crate::quantiles::quantile;

/// The y values of one bin in x.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct QuantileBin {
    /// Lower edge of the bin in x.
    pub low: f64,
    /// Upper edge.
    pub high: f64,
    /// Number of values in the bin.
    pub number: u64,
    /// Mean of y; `None` in an empty bin.
    pub mean: Option<f64>,
    /// 5, 10, 25, 50, 75, 90 and 95 % quantiles of y; `None` in an empty bin.
    pub quantiles: Option<[f64; 7]>,
}

impl QuantileBin {
    /// The probabilities of [`Self::quantiles`].
    pub const LEVELS: [f64; 7] = [0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95];
}

/// Sorts pairs (x, y) into bins of x, with the edge convention of [`crate::Histogram`]. Edges must ascend.
/// Pairs outside the edges are ignored.
pub fn binned_quantiles(edges: &[f64], pairs: impl IntoIterator<Item = (f64, f64)>) -> Vec<QuantileBin> {
    let mut bins = vec![Vec::new(); edges.len().saturating_sub(1)];
    for (x, y) in pairs {
        if let Some(index) = bin_index(edges, x) {
            bins[index].push(y);
        }
    }
    let of = |(edges, mut values): (&[f64], Vec<f64>)| {
        values.sort_by(f64::total_cmp);
        let known = !values.is_empty();
        let quantiles =
            known.then(|| QuantileBin::LEVELS.map(|share| quantile(&values, share).unwrap_or(f64::NAN)));
        let mean = known.then(|| values.iter().sum::<f64>() / values.len() as f64);
        QuantileBin { low: edges[0], high: edges[1], number: values.len() as u64, mean, quantiles }
    };
    edges.windows(2).zip(bins).map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_the_bin() {
        // 0 … 20 in the first bin: the quantile q is 20 q. One value in the last.
        let pairs = (0..=20).map(|y| (0.5, f64::from(y))).chain([(2.0, 7.0), (2.5, 1.0), (f64::NAN, 1.0)]);
        let bands = binned_quantiles(&[0.0, 1.0, 1.5, 2.0], pairs);
        assert_eq!([0, 1, 2].map(|k| bands[k].number), [21, 0, 1]);
        let found = bands[0].quantiles.unwrap();
        for (found, share) in found.iter().zip(QuantileBin::LEVELS) {
            assert!((found - 20.0 * share).abs() < 1e-12);
        }
        assert_eq!((bands[1].quantiles, bands[2].quantiles), (None, Some([7.0; 7])));
        assert_eq!([0, 1, 2].map(|k| bands[k].mean), [Some(10.0), None, Some(7.0)]);
        assert_eq!((bands[1].low, bands[1].high), (1.0, 1.5));
    }
}
