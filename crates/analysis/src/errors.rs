//! How well a grade predicts the force error of atoms.

use crate::quantiles::quantile;
use crate::rank_statistics::{roc_auc, spearman};
use crate::{Bins, SystematicSample};

/// Collects the grades and force errors of labelled atoms, and the grades of atoms whose label failed and whose
/// error is therefore unknown. Counts are exact. Rank statistics and quantiles use a sample if there are more
/// atoms than the capacity.
#[derive(Clone, Debug)]
pub struct ForceErrors {
    bins: Bins,
    threshold: f64,
    pairs: SystematicSample<(f64, f64)>,
    counts: Vec<Counts>,
    sum: f64,
    left_out: u64,
}

#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    labelled: u64,
    above: u64,
    unlabelled: u64,
}

/// Force errors of the atoms in one bin of the grade.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ErrorBin {
    /// Lower edge; `None` for the first bin.
    pub above: Option<f64>,
    /// Upper edge, inclusive; `None` for the last bin.
    pub up_to: Option<f64>,
    /// Labelled atoms.
    pub atoms: u64,
    /// Fraction of all labelled atoms that are in this bin.
    pub share: f64,
    /// Atoms of structures whose label failed.
    pub unlabelled: u64,
    /// Median force error, eV/Å; `None` in an empty bin, like the following fields.
    pub median: Option<f64>,
    /// 90 % quantile, eV/Å.
    pub p90: Option<f64>,
    /// 99 % quantile, eV/Å.
    pub p99: Option<f64>,
    /// Fraction of the labelled atoms with an error above the threshold.
    pub large: Option<f64>,
    /// Bounds of that fraction over all atoms: no, or every, unlabelled atom is above the threshold.
    pub large_between: Option<(f64, f64)>,
}

impl ForceErrors {
    /// An empty collection. Errors above `threshold`, eV/Å, count as large. Keeps at most `room` atoms, 17
    /// bytes each.
    pub fn new(bins: Bins, threshold: f64, room: usize) -> Self {
        let counts = vec![Counts::default(); bins.count()];
        Self { bins, threshold, pairs: SystematicSample::new(room), counts, sum: 0.0, left_out: 0 }
    }

    /// Adds a labelled atom with its grade and |F_model − F_label|, eV/Å. Values that are not finite are only
    /// counted.
    pub fn add(&mut self, grade: f64, error: f64) {
        if !(grade.is_finite() && error.is_finite()) {
            self.left_out += 1;
            return;
        }
        let counts = &mut self.counts[self.bins.index_of(grade)];
        counts.labelled += 1;
        counts.above += u64::from(error > self.threshold);
        self.sum += error;
        self.pairs.add((grade, error));
    }

    /// Adds an atom of a structure whose label failed.
    pub fn add_unlabelled(&mut self, grade: f64) {
        if grade.is_finite() {
            self.counts[self.bins.index_of(grade)].unlabelled += 1;
        } else {
            self.left_out += 1;
        }
    }

    /// Number of labelled atoms.
    pub fn atoms(&self) -> u64 {
        self.pairs.total()
    }

    /// Number of labelled atoms in the sample for rank statistics and quantiles.
    pub fn sampled(&self) -> usize {
        self.pairs.items().len()
    }

    /// Number of atoms without a finite grade or error.
    pub fn left_out(&self) -> u64 {
        self.left_out
    }

    /// Mean force error, eV/Å.
    pub fn mean(&self) -> Option<f64> {
        (self.atoms() > 0).then(|| self.sum / self.atoms() as f64)
    }

    /// Median force error, eV/Å.
    pub fn median(&self) -> Option<f64> {
        let (_, mut errors) = self.rows();
        errors.sort_by(f64::total_cmp);
        quantile(&errors, 0.5)
    }

    /// Fraction of the labelled atoms in the bins whose lower edge is at least `edge`.
    pub fn fraction_above(&self, edge: f64) -> Option<f64> {
        let is_above = |index: &usize| self.bins.edges(*index).0.is_some_and(|above| above >= edge);
        let above = (0..self.bins.count()).filter(is_above).map(|index| self.counts[index].labelled);
        (self.atoms() > 0).then(|| above.sum::<u64>() as f64 / self.atoms() as f64)
    }

    /// Spearman's ρ of grade and error.
    pub fn spearman(&self) -> Option<f64> {
        let (grades, errors) = self.rows();
        spearman(&grades, &errors)
    }

    /// Area under the ROC curve of the grade as a classifier of large errors.
    pub fn roc_auc(&self) -> Option<f64> {
        let (grades, errors) = self.rows();
        roc_auc(&grades, &errors, self.threshold)
    }

    /// The force errors by bin, including empty bins.
    pub fn bins(&self) -> Vec<ErrorBin> {
        let mut errors = vec![Vec::new(); self.bins.count()];
        for (grade, error) in self.pairs.items() {
            errors[self.bins.index_of(*grade)].push(*error);
        }
        errors.iter_mut().for_each(|errors| errors.sort_by(f64::total_cmp));
        (0..self.bins.count()).map(|index| self.bin(index, &errors[index])).collect()
    }

    fn bin(&self, index: usize, errors: &[f64]) -> ErrorBin {
        let Counts { labelled, above: large, unlabelled } = self.counts[index];
        let (above, up_to) = self.bins.edges(index);
        let part = |part: u64, of: u64| (of > 0).then(|| part as f64 / of as f64);
        let all = labelled + unlabelled;
        ErrorBin {
            above,
            up_to,
            atoms: labelled,
            share: part(labelled, self.atoms()).unwrap_or(0.0),
            unlabelled,
            median: quantile(errors, 0.5),
            p90: quantile(errors, 0.9),
            p99: quantile(errors, 0.99),
            large: part(large, labelled),
            large_between: part(large, all).zip(part(large + unlabelled, all)),
        }
    }

    fn rows(&self) -> (Vec<f64>, Vec<f64>) {
        self.pairs.items().copied().unzip()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn a_table_by_hand() {
        let mut errors = ForceErrors::new(Bins::for_grades(), 1.0, 1000);
        for (grade, error) in [(0.2, 0.1), (0.5, 0.3), (0.4, 0.2), (3.0, 1.0), (4.0, 2.0), (f64::NAN, 1.0)] {
            errors.add(grade, error);
        }
        [3.5, 4.5, 9.0].into_iter().for_each(|grade| errors.add_unlabelled(grade));
        let bins = errors.bins();
        assert_eq!((errors.atoms(), errors.left_out(), bins.len()), (5, 1, 7));
        assert_eq!((bins[0].atoms, bins[0].median, bins[0].large), (3, Some(0.2), Some(0.0)));
        assert_eq!((bins[0].share, bins[0].large_between), (0.6, Some((0.0, 0.0))));
        // An error of exactly 1 is not above 1. Two labels failed, so the fraction of four is between ¼ and ¾.
        let far = bins[5];
        assert_eq!((far.above, far.up_to, far.atoms, far.unlabelled), (Some(2.0), Some(5.0), 2, 2));
        assert_eq!((far.median, far.large, far.large_between), (Some(1.5), Some(0.5), Some((0.25, 0.75))));
        // Every label failed in one bin, and nothing was attempted in the other: these differ.
        assert_eq!((bins[6].median, bins[6].large, bins[6].large_between), (None, None, Some((0.0, 1.0))));
        assert_eq!((bins[1].atoms, bins[1].large_between), (0, None));
        assert_eq!((errors.mean(), errors.fraction_above(1.0)), (Some(3.6 / 5.0), Some(0.4)));
        assert_eq!(errors.median(), Some(0.3));
        // Grades 0.2 0.5 0.4 3 4 against 0.1 0.3 0.2 1 2: the same order.
        assert!((errors.spearman().unwrap() - 1.0).abs() < 1e-14);
        assert_eq!(errors.roc_auc(), Some(1.0));
    }

    proptest! {
        #[test]
        fn nothing_is_lost_and_a_sample_is_near(seed in 0_u64..1000) {
            let number = |k: u64| ((k * 2_654_435_761 + seed) % 1_000_003) as f64 / 1_000_003.0;
            let (mut all, mut some) = (
                ForceErrors::new(Bins::for_grades(), 1.0, 100_000),
                ForceErrors::new(Bins::for_grades(), 1.0, 2_000),
            );
            for k in 0..6_000 {
                let grade = 3.0 * number(k);
                let error = grade * number(7 * k + 1);
                all.add(grade, error);
                some.add(grade, error);
            }
            prop_assert!(all.sampled() == 6_000 && some.sampled() <= 2_000);
            let counts = |errors: &ForceErrors| -> Vec<_> {
                errors.bins().iter().map(|bin| (bin.atoms, bin.large)).collect()
            };
            prop_assert_eq!(counts(&all), counts(&some));
            prop_assert_eq!(all.bins().iter().map(|bin| bin.atoms).sum::<u64>(), 6_000);
            // The correlation of n pairs has an error of about 1 / √n, here at most 1/31.
            let (exact, sampled) = (all.spearman().unwrap(), some.spearman().unwrap());
            prop_assert!((exact - sampled).abs() < 0.16, "{} {}", exact, sampled);
        }
    }
}
