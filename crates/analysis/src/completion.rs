//! The fraction of attempted labels that succeeded.

use crate::{Bins, wilson_interval};

/// Counts labels and final label failures in bins of a quantity known for both, such as the grade or the
/// volume. A failed label is censored, not absent: it counts as attempted, and its structure is listed.
#[derive(Clone, Debug)]
pub struct Completion<T> {
    bins: Bins,
    counts: Vec<(u64, Vec<T>)>,
    unknown: (u64, Vec<T>),
}

/// The attempts in one bin.
#[derive(Clone, Debug, PartialEq)]
pub struct CompletionBin<T> {
    /// Lower edge; `None` for the first bin.
    pub above: Option<f64>,
    /// Upper edge, inclusive; `None` for the last bin.
    pub up_to: Option<f64>,
    /// Labelled structures.
    pub labelled: u64,
    /// Structures whose label finally failed.
    pub failed: Vec<T>,
    /// Labelled / attempted; `None` without attempts.
    pub share: Option<f64>,
    /// 95 % confidence interval of the probability of a label ([`wilson_interval`]).
    pub interval: Option<(f64, f64)>,
}

impl<T: Clone> Completion<T> {
    /// An empty table with these bins.
    pub fn new(bins: Bins) -> Self {
        let counts = vec![(0, Vec::new()); bins.count()];
        Self { bins, counts, unknown: (0, Vec::new()) }
    }

    /// Counts a labelled structure.
    pub fn add_labelled(&mut self, value: Option<f64>) {
        self.bin_mut(value).0 += 1;
    }

    /// Counts the structure `name`, whose label finally failed.
    pub fn add_failed(&mut self, value: Option<f64>, name: T) {
        self.bin_mut(value).1.push(name);
    }

    /// The table, including empty bins. A last row holds structures without a finite value, if there are any.
    pub fn bins(&self) -> Vec<CompletionBin<T>> {
        let sorted = self.counts.iter().enumerate();
        let mut bins: Vec<_> = sorted.map(|(place, counts)| bin(self.bins.edges(place), counts)).collect();
        if self.unknown.0 > 0 || !self.unknown.1.is_empty() {
            bins.push(bin((None, None), &self.unknown));
        }
        bins
    }

    fn bin_mut(&mut self, value: Option<f64>) -> &mut (u64, Vec<T>) {
        match value.filter(|value| value.is_finite()) {
            Some(value) => &mut self.counts[self.bins.index_of(value)],
            None => &mut self.unknown,
        }
    }
}

fn bin<T: Clone>(
    (above, up_to): (Option<f64>, Option<f64>),
    (labelled, failed): &(u64, Vec<T>),
) -> CompletionBin<T> {
    let attempted = labelled + failed.len() as u64;
    CompletionBin {
        above,
        up_to,
        labelled: *labelled,
        failed: failed.clone(),
        share: (attempted > 0).then(|| *labelled as f64 / attempted as f64),
        interval: wilson_interval(*labelled, attempted),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn failures_count_among_the_attempted() {
        let mut completion = Completion::new(Bins::for_volume_ratio());
        for _ in 0..3 {
            completion.add_labelled(Some(1.0));
        }
        completion.add_labelled(Some(1.4));
        completion.add_failed(Some(1.42), "a");
        completion.add_failed(Some(1.38), "b");
        completion.add_failed(Some(1.5), "c");
        let bins = completion.bins();
        assert_eq!(bins.len(), 7);
        assert_eq!((bins[1].labelled, bins[1].share, &bins[1].failed), (3, Some(1.0), &vec![]));
        assert_eq!((bins[5].above, bins[5].up_to), (Some(1.35), Some(1.45)));
        assert_eq!((bins[5].labelled, bins[5].share), (1, Some(1.0 / 3.0)));
        assert_eq!((&bins[5].failed, bins[5].interval), (&vec!["a", "b"], wilson_interval(1, 3)));
        assert_eq!((bins[6].share, bins[6].up_to), (Some(0.0), None));
        assert_eq!((bins[0].share, bins[0].interval), (None, None));
    }

    #[test]
    fn what_has_no_value_is_not_lost() {
        let mut completion = Completion::new(Bins::for_grades());
        completion.add_labelled(None);
        completion.add_failed(Some(f64::INFINITY), "a");
        let last = completion.bins().pop().unwrap();
        assert_eq!((last.above, last.up_to, last.labelled, last.failed), (None, None, 1, vec!["a"]));
    }
}
