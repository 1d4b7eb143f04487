//! Bins of grades and volumes.

/// Adjacent bins that cover the real line. A value on an edge belongs to the bin below, so that γ = 1 counts as
/// known.
#[derive(Clone, Debug, PartialEq)]
pub struct Bins(Vec<f64>);

impl Bins {
    /// Bins between these edges, which must ascend. The first and the last bin are open.
    ///
    /// # Panics
    /// If the edges do not ascend, which is a bug of the caller.
    pub fn new(edges: &[f64]) -> Self {
        assert!(edges.is_sorted_by(|a, b| a < b), "edges ascend");
        Self(edges.to_vec())
    }

    /// The bins of the paper's table of force errors: 0–0.5, 0.5–0.75, 0.75–1, 1–1.5, 1.5–2, 2–5 and above 5.
    pub fn for_grades() -> Self {
        Self::new(&[0.5, 0.75, 1.0, 1.5, 2.0, 5.0])
    }

    /// Bins of V/V₀, 0.1 wide and centred on 1, 1.1 … 1.4: an unchanged volume is not on an edge.
    pub fn for_volume_ratio() -> Self {
        Self::new(&[0.95, 1.05, 1.15, 1.25, 1.35, 1.45])
    }

    /// Number of bins.
    pub fn count(&self) -> usize {
        self.0.len() + 1
    }

    /// Index of the bin that holds the value, from 0.
    pub fn index_of(&self, value: f64) -> usize {
        self.0.partition_point(|edge| *edge < value)
    }

    /// Lower and upper edge of a bin; `None` where it is open.
    pub fn edges(&self, index: usize) -> (Option<f64>, Option<f64>) {
        let below = index.checked_sub(1).and_then(|below| self.0.get(below));
        (below.copied(), self.0.get(index).copied())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_is_in_the_bin_whose_edges_hold_it() {
        let bins = Bins::for_grades();
        assert_eq!(bins.count(), 7);
        for (value, index) in
            [(0.0, 0), (0.5, 0), (0.500_001, 1), (1.0, 2), (1.2, 3), (5.0, 5), (5.1, 6), (1e9, 6)]
        {
            assert_eq!(bins.index_of(value), index, "{value}");
            let (above, up_to) = bins.edges(index);
            assert!(above.is_none_or(|edge| value > edge) && up_to.is_none_or(|edge| value <= edge));
        }
        assert_eq!((bins.edges(0), bins.edges(6)), ((None, Some(0.5)), (Some(5.0), None)));
        assert_eq!(Bins::for_volume_ratio().index_of(1.0), 1);
    }
}
