//! Where values are sorted into.

/// Bins that follow one another: a value on an edge belongs to the bin below it, so that a grade of 1 is on the side
/// that is known. The first has no lower end and the last no upper one.
#[derive(Clone, Debug, PartialEq)]
pub struct Bins(Vec<f64>);

impl Bins {
    /// Between these edges, which ascend.
    ///
    /// # Panics
    /// If they do not: an error of the caller, not of input.
    pub fn new(edges: &[f64]) -> Self {
        assert!(edges.is_sorted_by(|a, b| a < b), "edges ascend");
        Self(edges.to_vec())
    }

    /// Those of the paper's table of force errors by grade: 0–0.5, 0.5–0.75, 0.75–1, 1–1.5, 1.5–2, 2–5 and above 5.
    pub fn for_grades() -> Self {
        Self::new(&[0.5, 0.75, 1.0, 1.5, 2.0, 5.0])
    }

    /// For V/V₀, a tenth wide and centred on 1, 1.1 … 1.4: a cell that keeps its volume is not on an edge.
    pub fn for_volume_ratio() -> Self {
        Self::new(&[0.95, 1.05, 1.15, 1.25, 1.35, 1.45])
    }

    /// How many there are.
    pub fn count(&self) -> usize {
        self.0.len() + 1
    }

    /// The one that a value is in, from 0.
    pub fn index_of(&self, value: f64) -> usize {
        self.0.partition_point(|edge| *edge < value)
    }

    /// Lower and upper edge of a bin, `None` where it has none.
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
