//! Histograms of σ on a logarithmic grid, and what is read from them.

use serde::{Deserialize, Serialize};

use super::error::{BuildError, expect_length, expect_same};

/// Number of bins.
pub const BINS: usize = 1000;

/// The distribution of σ over the training atoms of a component, with and without weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SigmaHistogram {
    /// Atoms in each bin, `[1000]`.
    pub raw: Vec<u64>,
    /// Their weights, `[1000]`.
    pub weighted: Vec<f64>,
}

/// The histograms of the components of an element, of one shard or of all shards up to one. Serialisable.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ElementHistograms {
    /// In the order of the components.
    pub components: Vec<SigmaHistogram>,
}

impl Default for SigmaHistogram {
    fn default() -> Self {
        Self { raw: vec![0; BINS], weighted: vec![0.0; BINS] }
    }
}

impl SigmaHistogram {
    /// Number of atoms.
    pub fn count(&self) -> u64 {
        self.raw.iter().sum()
    }

    /// Number of atoms with σ above `sigma`, where atoms spread evenly inside a bin; not whole.
    pub fn count_above(&self, sigma: f64) -> f64 {
        let counts: Vec<f64> = self.raw.iter().map(|&count| count as f64).collect();
        let grid = BinEdges::default();
        let distribution = Distribution::new(&grid, &counts);
        distribution.map_or(0.0, |found| (1.0 - found.share_below(sigma)) * found.total())
    }
}

impl ElementHistograms {
    /// Histograms without atoms.
    pub fn empty(components: usize) -> Self {
        Self { components: vec![SigmaHistogram::default(); components] }
    }

    /// All numbers in one row, for [`ExactSums`](super::ExactSums).
    pub fn to_row(&self) -> Vec<f64> {
        let numbers = |histogram: &SigmaHistogram| {
            let mut numbers: Vec<f64> = histogram.raw.iter().map(|&count| count as f64).collect();
            numbers.extend(&histogram.weighted);
            numbers
        };
        self.components.iter().flat_map(numbers).collect()
    }

    /// The histograms from their row, which has a whole number of components.
    ///
    /// # Errors
    /// A row of another length.
    pub fn from_row(row: &[f64]) -> Result<Self, BuildError> {
        expect_length("histograms of an element", row.len(), row.len().next_multiple_of(2 * BINS))?;
        let components = row.chunks_exact(2 * BINS).map(|numbers| SigmaHistogram {
            raw: numbers[..BINS].iter().map(|&count| count as u64).collect(),
            weighted: numbers[BINS..].to_vec(),
        });
        Ok(Self { components: components.collect() })
    }

    /// Adds the histograms of the next shard; for the order, see [`super::ElementSums::merge`].
    ///
    /// # Errors
    /// Histograms of another number of components or bins. Nothing is added then.
    pub fn merge(&mut self, next: &Self) -> Result<(), BuildError> {
        let (found, expected) = (next.components.len(), self.components.len());
        expect_same("the number of components", found as u64, expected as u64)?;
        for histogram in &next.components {
            expect_same("the number of bins", histogram.raw.len() as u64, BINS as u64)?;
            expect_same("the number of bins", histogram.weighted.len() as u64, BINS as u64)?;
        }
        for (histogram, next) in self.components.iter_mut().zip(&next.components) {
            histogram.raw.iter_mut().zip(&next.raw).for_each(|(sum, value)| *sum += value);
            histogram.weighted.iter_mut().zip(&next.weighted).for_each(|(sum, value)| *sum += value);
        }
        Ok(())
    }
}

/// Edges of the bins, 10⁻² to 10³ in equal ratios, `[1001]`.
#[derive(Debug, Clone, PartialEq)]
pub struct BinEdges {
    edges: Vec<f64>,
}

impl Default for BinEdges {
    fn default() -> Self {
        Self { edges: (0..=BINS).map(|k| 10_f64.powf(-2.0 + 5.0 * k as f64 / BINS as f64)).collect() }
    }
}

impl BinEdges {
    /// The edges, ascending.
    pub fn edges(&self) -> &[f64] {
        &self.edges
    }

    /// The bin of σ: the last whose lower edge is not above it. The first and the last bin also have what is outside.
    pub fn bin(&self, sigma: f64) -> usize {
        self.edges.partition_point(|edge| *edge <= sigma).saturating_sub(1).min(BINS - 1)
    }
}

/// The cumulative distribution of a histogram, linear inside its bins.
#[derive(Debug, Clone)]
pub(super) struct Distribution<'a> {
    grid: &'a BinEdges,
    counts: &'a [f64],
    /// Sum of the counts of the bins before each edge.
    cumulative: Vec<f64>,
}

impl<'a> Distribution<'a> {
    /// `None` without counts.
    pub fn new(grid: &'a BinEdges, counts: &'a [f64]) -> Option<Self> {
        let mut cumulative = vec![0.0];
        let mut sum = 0.0;
        cumulative.extend(counts.iter().map(|count| {
            sum += count;
            sum
        }));
        (sum > 0.0).then_some(Self { grid, counts, cumulative })
    }

    fn total(&self) -> f64 {
        self.cumulative[self.counts.len()]
    }

    /// F⁻¹(`share`), 0 < `share` ≤ 1.
    pub fn quantile(&self, share: f64) -> f64 {
        let target = share * self.total();
        let bin = self.cumulative[1..].partition_point(|sum| *sum < target).min(self.counts.len() - 1);
        let (low, high) = (self.grid.edges[bin], self.grid.edges[bin + 1]);
        low + (high - low) * (target - self.cumulative[bin]) / self.counts[bin]
    }

    /// F(`sigma`).
    pub fn share_below(&self, sigma: f64) -> f64 {
        let edges = &self.grid.edges;
        let after = edges.partition_point(|edge| *edge <= sigma);
        match after.checked_sub(1) {
            None => 0.0,
            Some(bin) if bin >= self.counts.len() => 1.0,
            Some(bin) => {
                let inside = (sigma - edges[bin]) / (edges[bin + 1] - edges[bin]);
                (self.cumulative[bin] + inside * self.counts[bin]) / self.total()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::build::tests::{assert_near, numbers, unit_cases};

    #[test]
    fn grid_and_bins_are_those_of_the_reference() {
        let (cases, grid) = (unit_cases(), BinEdges::default());
        let case = &cases["hist_grid"];
        assert_eq!(case["n_bins"], BINS);
        assert_near(&grid.edges()[..4], &numbers(&case["first"]), 1e-15);
        assert_near(&grid.edges()[BINS - 2..], &numbers(&case["last"]), 1e-15);
        let case = &cases["sigma_bins"];
        for (sigma, bin) in numbers(&case["sigma"]).into_iter().zip(numbers(&case["bins"])) {
            assert_eq!(grid.bin(sigma) as f64, bin, "{sigma}");
        }
        assert_eq!([grid.bin(0.0), grid.bin(f64::INFINITY)], [0, BINS - 1]);
    }

    #[test]
    fn quantiles_invert_the_distribution() {
        let grid = BinEdges::default();
        let counts: Vec<f64> = (0..BINS).map(|k| if k % 7 == 3 { (k % 50) as f64 } else { 0.0 }).collect();
        let distribution = Distribution::new(&grid, &counts).unwrap();
        for share in [1e-6, 0.01, 0.3, 0.5, 0.77, 0.99, 1.0] {
            let found = distribution.share_below(distribution.quantile(share));
            assert!((found - share).abs() < 1e-12, "{share} {found}");
        }
        let spread = SigmaHistogram {
            raw: counts.iter().map(|&count| count as u64).collect(),
            ..SigmaHistogram::default()
        };
        let (median, total) = (distribution.quantile(0.5), spread.count() as f64);
        assert!((spread.count_above(median) / total - 0.5).abs() < 1e-12);
        assert_eq!((spread.count_above(2e3), SigmaHistogram::default().count_above(1.0)), (0.0, 0.0));
        assert_eq!([distribution.share_below(0.0), distribution.share_below(2e3)], [0.0, 1.0]);
        assert!(Distribution::new(&grid, &[0.0; BINS]).is_none());
    }
}
