//! Statistics that depend on the order of values only.

/// Spearman's ρ: Pearson's correlation of the ranks, with mean ranks for ties. `None` for fewer than two values
/// or if all values of one argument are equal.
///
/// # Panics
/// If the lengths differ.
pub fn spearman(a: &[f64], b: &[f64]) -> Option<f64> {
    assert_eq!(a.len(), b.len(), "pairs of values");
    let (a, b) = (average_ranks(a), average_ranks(b));
    // The mean rank does not depend on the values.
    let mean = 0.5 * (a.len() as f64 + 1.0);
    let (mut covariance, mut variance_a, mut variance_b) = (0.0, 0.0, 0.0);
    for (x, y) in a.iter().zip(&b) {
        covariance += (x - mean) * (y - mean);
        variance_a += (x - mean).powi(2);
        variance_b += (y - mean).powi(2);
    }
    let spread = (variance_a * variance_b).sqrt();
    (spread > 0.0).then(|| covariance / spread)
}

/// Area under the ROC curve of `grades` as a classifier of `errors` above `threshold`: the probability that the
/// atom with the larger error has the larger grade, where ties count half (Mann and Whitney). `None` if all
/// errors are on the same side of the threshold.
///
/// # Panics
/// If the lengths differ.
pub fn roc_auc(grades: &[f64], errors: &[f64], threshold: f64) -> Option<f64> {
    assert_eq!(grades.len(), errors.len(), "a grade for each error");
    let (mut positive, mut ranks_of_positive) = (0_u64, 0.0);
    for (rank, error) in average_ranks(grades).iter().zip(errors) {
        if *error > threshold {
            positive += 1;
            ranks_of_positive += rank;
        }
    }
    let (positive, negative) = (positive as f64, grades.len() as f64 - positive as f64);
    let wins = ranks_of_positive - 0.5 * positive * (positive + 1.0);
    (positive > 0.0 && negative > 0.0).then(|| wins / (positive * negative))
}

/// Rank of each value, from 1; ties share their mean rank.
fn average_ranks(values: &[f64]) -> Vec<f64> {
    let value = |i: &u32| values[*i as usize];
    let mut order: Vec<_> = (0..values.len() as u32).collect();
    order.sort_by(|i, j| value(i).total_cmp(&value(j)));
    let mut ranks = vec![0.0; values.len()];
    let mut before = 0;
    for run in order.chunk_by(|i, j| value(i) == value(j)) {
        let rank = before as f64 + 0.5 * (run.len() + 1) as f64;
        run.iter().for_each(|i| ranks[*i as usize] = rank);
        before += run.len();
    }
    ranks
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn spearman_is_that_of_the_ranks() {
        let near = |a: Option<f64>, b: f64| assert!((a.unwrap() - b).abs() < 1e-14, "{a:?} {b}");
        near(spearman(&[1.0, 2.0, 3.0], &[1.0, 10.0, 1000.0]), 1.0);
        near(spearman(&[1.0, 2.0, 3.0], &[3.0, 2.0, -1.0]), -1.0);
        // Ranks 1 2.5 2.5 4 5 and 2 1 3.5 3.5 5: 7.25 / √(9.5 · 9.5).
        near(spearman(&[1.0, 2.0, 2.0, 4.0, 5.0], &[2.0, 1.0, 3.0, 3.0, 5.0]), 7.25 / 9.5);
        assert_eq!(spearman(&[1.0], &[1.0]), None);
        assert_eq!(spearman(&[], &[]), None);
        assert_eq!(spearman(&[2.0, 2.0], &[1.0, 3.0]), None);
        // Both zeros are equal.
        assert_eq!(average_ranks(&[0.0, -0.0, 1.0]), [1.5, 1.5, 3.0]);
    }

    #[test]
    fn auc_counts_pairs() {
        // Above 1: grades 2 and 4; below: 1, 2 and 3. Pairs won: 1 + ½ + 0 and 3, of 6.
        let (grades, errors) = ([1.0, 2.0, 2.0, 3.0, 4.0], [0.1, 0.5, 1.5, 1.0, 7.0]);
        assert_eq!(roc_auc(&grades, &errors, 1.0), Some(4.5 / 6.0));
        assert_eq!(roc_auc(&grades, &errors, 10.0), None);
        assert_eq!(roc_auc(&grades, &errors, 0.01), None);
        assert_eq!(roc_auc(&[1.0, 2.0], &[0.0, 2.0], 1.0), Some(1.0));
    }

    /// Reference implementation over all pairs.
    fn auc_by_pairs(grades: &[f64], errors: &[f64], threshold: f64) -> Option<f64> {
        let (mut won, mut pairs) = (0.0, 0.0);
        for (grade, error) in grades.iter().zip(errors) {
            for (other, smaller) in grades.iter().zip(errors) {
                if *error > threshold && *smaller <= threshold {
                    pairs += 1.0;
                    won += if grade > other { 1.0 } else { 0.5 * f64::from(u8::from(grade == other)) };
                }
            }
        }
        (pairs > 0.0).then(|| won / pairs)
    }

    /// Rank: the number of smaller values plus half the number of equal ones.
    fn rank(values: &[f64], value: f64) -> f64 {
        let count = |test: &dyn Fn(f64) -> bool| values.iter().filter(|x| test(**x)).count() as f64;
        count(&|x| x < value) + 0.5 * (count(&|x| x == value) + 1.0)
    }

    proptest! {
        #[test]
        fn ranks_and_areas_are_those_of_counting(
            pairs in prop::collection::vec((0_u8..12, 0_u8..12), 2..60)
        ) {
            let (grades, errors): (Vec<_>, Vec<_>) =
                pairs.iter().map(|(a, b)| (f64::from(*a) * 0.3, f64::from(*b) * 0.2)).unzip();
            let counted: Vec<_> = grades.iter().map(|grade| rank(&grades, *grade)).collect();
            prop_assert_eq!(average_ranks(&grades), counted);
            match (roc_auc(&grades, &errors, 1.0), auc_by_pairs(&grades, &errors, 1.0)) {
                (Some(a), Some(b)) => prop_assert!((a - b).abs() < 1e-12),
                (a, b) => prop_assert_eq!(a, b),
            }
            if let Some(rho) = spearman(&grades, &errors) {
                prop_assert!(rho.abs() <= 1.0 + 1e-12);
                let stretched: Vec<_> = grades.iter().map(|grade| grade.exp()).collect();
                prop_assert_eq!(spearman(&stretched, &errors), Some(rho));
            }
        }
    }
}
