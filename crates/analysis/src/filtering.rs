//! What a threshold of a grade keeps of a table, against random subsets of the same size.

use crate::random::Draw;

/// A row of the table, such as a structure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GradedRow {
    /// The grade; rows with at most the threshold are kept.
    pub grade: f64,
    /// The error; its absolute value counts.
    pub error: f64,
    /// Whether the row is predicted to be in the class, and whether it is.
    pub class: Option<(bool, bool)>,
}

/// Quality of the predictions of a subset. A quantity is `None` where it would divide by zero.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Quality {
    /// Mean absolute error.
    pub mean_error: Option<f64>,
    /// Share of the rows predicted to be in the class that are.
    pub precision: Option<f64>,
    /// Share of the rows in the class that are predicted to be.
    pub recall: Option<f64>,
    /// Harmonic mean of precision and recall.
    pub f1: Option<f64>,
}

/// What one threshold does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FilterStep {
    /// The threshold of the grade.
    pub threshold: f64,
    /// Rows that are kept.
    pub kept: usize,
    /// Their quality.
    pub quality: Quality,
    /// Mean over random subsets with as many rows, of those in which the quantity is defined.
    pub random_mean: Quality,
    /// Standard deviation over them (divisor n − 1).
    pub random_deviation: Quality,
}

/// Sums over a subset.
#[derive(Clone, Copy, Debug, Default)]
struct SubsetSums {
    rows: u64,
    error: f64,
    predicted: u64,
    actual: u64,
    both: u64,
}

/// Filters the rows at each threshold, and compares with `draws` random subsets of the same size, drawn without
/// replacement (paper, Methods, Matbench Discovery evaluation). A draw is a random order of the rows, and its subsets
/// are the first rows of it: those of different thresholds are subsets of each other, as the kept ones are.
///
/// Costs `draws` passes over the rows.
pub fn filter_sweep(rows: &[GradedRow], thresholds: &[f64], draws: u32, seed: u64) -> Vec<FilterStep> {
    let kept = |threshold: f64| rows.iter().filter(move |row| row.grade <= threshold);
    let sizes: Vec<_> = thresholds.iter().map(|threshold| kept(*threshold).count()).collect();
    let random: Vec<_> = (0..draws).map(|draw| random_subsets(rows, &sizes, Draw::new(seed, draw))).collect();
    let step = |(k, threshold): (usize, &f64)| {
        let mut sums = SubsetSums::default();
        kept(*threshold).for_each(|row| sums.add(row));
        let over = |of: fn(&Quality) -> Option<f64>, moment: fn(&[f64]) -> Option<f64>| {
            moment(&random.iter().filter_map(|draw| of(&draw[k])).collect::<Vec<_>>())
        };
        let moments = |moment| Quality {
            mean_error: over(|quality| quality.mean_error, moment),
            precision: over(|quality| quality.precision, moment),
            recall: over(|quality| quality.recall, moment),
            f1: over(|quality| quality.f1, moment),
        };
        FilterStep {
            threshold: *threshold,
            kept: sizes[k],
            quality: sums.quality(),
            random_mean: moments(mean),
            random_deviation: moments(deviation),
        }
    };
    thresholds.iter().enumerate().map(step).collect()
}

/// Quality of the first rows of a random order (Fisher–Yates), for each size.
fn random_subsets(rows: &[GradedRow], sizes: &[usize], draw: Draw) -> Vec<Quality> {
    let mut order: Vec<_> = (0..rows.len()).collect();
    let mut by_size: Vec<_> = (0..sizes.len()).collect();
    by_size.sort_by_key(|k| sizes[*k]);
    let (mut found, mut sums, mut taken) = (vec![Quality::default(); sizes.len()], SubsetSums::default(), 0);
    for k in by_size {
        for place in taken..sizes[k] {
            order.swap(place, place + draw.below(place, rows.len() - place));
            sums.add(&rows[order[place]]);
        }
        taken = sizes[k];
        found[k] = sums.quality();
    }
    found
}

impl SubsetSums {
    fn add(&mut self, row: &GradedRow) {
        self.rows += 1;
        self.error += row.error.abs();
        if let Some((predicted, actual)) = row.class {
            self.predicted += u64::from(predicted);
            self.actual += u64::from(actual);
            self.both += u64::from(predicted && actual);
        }
    }

    fn quality(&self) -> Quality {
        let share = |part: f64, of: u64| (of > 0).then(|| part / of as f64);
        Quality {
            mean_error: share(self.error, self.rows),
            precision: share(self.both as f64, self.predicted),
            recall: share(self.both as f64, self.actual),
            f1: share(2.0 * self.both as f64, self.predicted + self.actual),
        }
    }
}

fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

fn deviation(values: &[f64]) -> Option<f64> {
    let mean = mean(values).filter(|_| values.len() > 1)?;
    let squares: f64 = values.iter().map(|x| (x - mean).powi(2)).sum();
    Some((squares / (values.len() - 1) as f64).sqrt())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn row(grade: f64, error: f64, class: Option<(bool, bool)>) -> GradedRow {
        GradedRow { grade, error, class }
    }

    #[test]
    fn a_table_by_hand() {
        let rows = [
            row(0.2, -1.0, Some((true, true))),
            row(0.4, 2.0, Some((false, true))),
            row(1.0, 3.0, Some((true, false))),
            row(3.0, 10.0, Some((false, false))),
            row(4.0, 4.0, Some((true, true))),
        ];
        let steps = filter_sweep(&rows, &[0.1, 1.0, 9.0], 7, 1);
        assert_eq!(steps.iter().map(|step| step.kept).collect::<Vec<_>>(), [0, 3, 5]);
        assert_eq!(steps[0].quality, Quality::default());
        assert_eq!(steps[0].random_mean, Quality::default());
        let some = |mean_error, precision, recall, f1| Quality {
            mean_error: Some(mean_error),
            precision: Some(precision),
            recall: Some(recall),
            f1: Some(f1),
        };
        assert_eq!(steps[1].quality, some(2.0, 0.5, 0.5, 0.5));
        // Every subset of all rows is the table itself.
        assert_eq!(steps[2].quality, some(4.0, 2.0 / 3.0, 2.0 / 3.0, 2.0 / 3.0));
        assert_eq!(steps[2].random_mean.mean_error, Some(4.0));
        assert_eq!(steps[2].random_deviation.mean_error, Some(0.0));
    }

    #[test]
    fn random_subsets_have_the_moments_of_sampling_without_replacement() {
        // Errors 0 … 99, of which 25 are drawn: the mean is 49.5, its variance (N² − 1)/12 · (N/(N−1)) / n · (1 − n/N).
        let rows: Vec<_> =
            (0..100).map(|k| row(if k % 4 == 0 { 0.0 } else { 2.0 }, f64::from(k), None)).collect();
        let [step] = filter_sweep(&rows, &[1.0], 4000, 3)[..] else { panic!("one threshold") };
        let variance = (9999.0 / 12.0) * (100.0 / 99.0) / 25.0 * 0.75;
        let (mean, deviation) =
            (step.random_mean.mean_error.unwrap(), step.random_deviation.mean_error.unwrap());
        assert_eq!((step.kept, step.quality.mean_error), (25, Some(48.0)));
        assert!((mean - 49.5).abs() < 5.0 * (variance / 4000.0_f64).sqrt(), "{mean}");
        // The relative error of a standard deviation of n normal numbers is 1 / √(2 n).
        assert!((deviation / variance.sqrt() - 1.0).abs() < 5.0 / 8000_f64.sqrt(), "{deviation}");
        assert_eq!(step.quality.precision, None);
    }

    proptest! {
        #[test]
        fn thresholds_do_not_depend_on_each_other(
            grades in prop::collection::vec(0.0..3.0, 0..40), seed in any::<u64>()
        ) {
            let rows: Vec<_> = grades.iter().enumerate().map(|(k, grade)| row(*grade, k as f64, None)).collect();
            let together = filter_sweep(&rows, &[2.0, 0.5, 1.0], 5, seed);
            for step in &together {
                prop_assert_eq!(&filter_sweep(&rows, &[step.threshold], 5, seed)[0], step);
            }
        }
    }
}
