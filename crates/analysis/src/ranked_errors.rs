//! How well scores rank errors, for many resamplings of the same items.

/// Errors and the scores of the same items, sorted once. The statistics of a resampling then cost one pass over the
/// items in the order of each score, some 20 ns an item.
#[derive(Clone, Debug)]
pub struct RankedErrors {
    /// Ascending, as are the items.
    errors: AscendingItems,
    sorted: Vec<f64>,
    /// The unit of each item.
    units: Vec<u32>,
    scores: Vec<AscendingItems>,
}

/// How well a score ranks errors.
#[derive(Clone, Debug, PartialEq)]
pub struct RankStatistics {
    /// Spearman's ρ, see [`crate::spearman`].
    pub spearman: Option<f64>,
    /// Area under the ROC curve for errors above each threshold, see [`crate::roc_auc`].
    pub auc: Vec<Option<f64>>,
}

/// Items in ascending order of a quantity.
#[derive(Clone, Debug)]
struct AscendingItems {
    items: Vec<u32>,
    /// Ends of the runs of equal values.
    ends: Vec<u32>,
}

impl RankedErrors {
    /// Items with these errors, each of a unit, and any number of scores (larger is worse).
    ///
    /// # Panics
    /// If lengths differ.
    pub fn new(errors: &[f64], units: &[u32], scores: &[Vec<f64>]) -> Self {
        let is_complete = scores.iter().all(|scores| scores.len() == errors.len());
        assert!(errors.len() == units.len() && is_complete, "a unit and scores for each error");
        let ascending = AscendingItems::from_values(errors).items;
        let permuted =
            |values: &[f64]| -> Vec<f64> { ascending.iter().map(|i| values[*i as usize]).collect() };
        let sorted = permuted(errors);
        Self {
            errors: AscendingItems::from_values(&sorted),
            sorted,
            units: ascending.iter().map(|i| units[*i as usize]).collect(),
            scores: scores.iter().map(|scores| AscendingItems::from_values(&permuted(scores))).collect(),
        }
    }

    /// Number of items.
    pub fn len(&self) -> usize {
        self.sorted.len()
    }

    /// Whether there are no items.
    pub fn is_empty(&self) -> bool {
        self.sorted.is_empty()
    }

    /// The statistics of each score if every item of unit u is there `multiplicities[u]` times. `thresholds` ascend.
    ///
    /// # Panics
    /// If a unit has no multiplicity.
    pub fn statistics(&self, multiplicities: &[u32], thresholds: &[f64]) -> Vec<RankStatistics> {
        let weights: Vec<_> =
            self.units.iter().map(|unit| f64::from(multiplicities[*unit as usize])).collect();
        let first_above: Vec<_> =
            thresholds.iter().map(|threshold| self.sorted.partition_point(|x| x <= threshold)).collect();
        let (mut of_errors, mut of_scores) = (vec![0.0; self.len()], vec![0.0; self.len()]);
        self.errors.ranks(&weights, &mut of_errors);
        let statistics = |order: &AscendingItems| {
            order.ranks(&weights, &mut of_scores);
            RankStatistics {
                spearman: weighted_correlation(&weights, &of_errors, &of_scores),
                auc: areas(&weights, &of_scores, &first_above),
            }
        };
        self.scores.iter().map(statistics).collect()
    }
}

impl AscendingItems {
    fn from_values(values: &[f64]) -> Self {
        let mut items: Vec<_> = (0..values.len() as u32).collect();
        items.sort_by(|i, j| values[*i as usize].total_cmp(&values[*j as usize]));
        let runs = items.chunk_by(|i, j| values[*i as usize] == values[*j as usize]);
        let ends = runs.scan(0, |end, run| {
            *end += run.len() as u32;
            Some(*end)
        });
        Self { ends: ends.collect(), items }
    }

    /// Mean rank of each item, if it is there as often as its weight.
    fn ranks(&self, weights: &[f64], ranks: &mut [f64]) {
        let (mut begin, mut before) = (0, 0.0);
        for end in &self.ends {
            let run = &self.items[begin..*end as usize];
            let weight: f64 = run.iter().map(|i| weights[*i as usize]).sum();
            run.iter().for_each(|i| ranks[*i as usize] = before + 0.5 * (weight + 1.0));
            before += weight;
            begin = *end as usize;
        }
    }
}

/// Pearson's correlation of ranks. `None` if one of them does not vary.
fn weighted_correlation(weights: &[f64], a: &[f64], b: &[f64]) -> Option<f64> {
    let mean = 0.5 * (weights.iter().sum::<f64>() + 1.0);
    let (mut covariance, mut variance_a, mut variance_b) = (0.0, 0.0, 0.0);
    for ((w, a), b) in weights.iter().zip(a).zip(b) {
        covariance += w * (a - mean) * (b - mean);
        variance_a += w * (a - mean).powi(2);
        variance_b += w * (b - mean).powi(2);
    }
    let spread = (variance_a * variance_b).sqrt();
    (spread > 0.0).then(|| covariance / spread)
}

/// Areas under the ROC curve if the items from each of these places on are positive, from the ranks of their scores.
fn areas(weights: &[f64], ranks: &[f64], first_above: &[usize]) -> Vec<Option<f64>> {
    let total: f64 = weights.iter().sum();
    let (mut positive, mut sum, mut end) = (0.0, 0.0, weights.len());
    let mut found = Vec::with_capacity(first_above.len());
    for begin in first_above.iter().rev() {
        for (w, rank) in weights[*begin..end].iter().zip(&ranks[*begin..end]) {
            positive += w;
            sum += w * rank;
        }
        end = *begin;
        let (negative, wins) = (total - positive, sum - 0.5 * positive * (positive + 1.0));
        found.push((positive > 0.0 && negative > 0.0).then(|| wins / (positive * negative)));
    }
    found.reverse();
    found
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{roc_auc, spearman};

    const THRESHOLDS: [f64; 4] = [0.1, 0.5, 1.0, 3.0];

    fn near(a: Option<f64>, b: Option<f64>) -> bool {
        match (a, b) {
            (Some(a), Some(b)) => (a - b).abs() < 1e-12,
            (a, b) => a == b,
        }
    }

    /// Errors, units and scores with ties.
    fn items() -> impl Strategy<Value = Vec<(u8, u32, u8)>> {
        prop::collection::vec((0_u8..12, 0_u32..6, 0_u8..12), 0..60)
    }

    proptest! {
        /// Statistics with multiplicities are those of the list in which every item is repeated.
        #[test]
        fn multiplicities_repeat_items(items in items(), counts in prop::collection::vec(0_u32..4, 6)) {
            let column = |of: fn(&(u8, u32, u8)) -> f64| items.iter().map(of).collect::<Vec<_>>();
            let (errors, scores) = (column(|x| f64::from(x.0) * 0.3), column(|x| f64::from(x.2) * 0.2));
            let units: Vec<_> = items.iter().map(|item| item.1).collect();
            let reversed = scores.iter().map(|score| -score).collect::<Vec<_>>();
            let ranked = RankedErrors::new(&errors, &units, &[scores.clone(), reversed]);
            let found = ranked.statistics(&counts, &THRESHOLDS);
            let repeated = |values: &[f64]| -> Vec<f64> {
                let times = |unit: &u32| counts[*unit as usize] as usize;
                values.iter().zip(&units).flat_map(|(x, unit)| vec![*x; times(unit)]).collect()
            };
            let (errors, scores) = (repeated(&errors), repeated(&scores));
            prop_assert!(near(found[0].spearman, spearman(&scores, &errors)));
            for (k, threshold) in THRESHOLDS.into_iter().enumerate() {
                let expected = roc_auc(&scores, &errors, threshold);
                prop_assert!(near(found[0].auc[k], expected));
                // The opposite score loses where the score wins.
                prop_assert!(near(found[1].auc[k], expected.map(|area| 1.0 - area)));
            }
        }

        /// Only the order of scores matters.
        #[test]
        fn areas_do_not_depend_on_a_monotonic_scale(items in items()) {
            let errors: Vec<_> = items.iter().map(|item| f64::from(item.0) * 0.3).collect();
            let scores: Vec<_> = items.iter().map(|item| f64::from(item.2)).collect();
            let scaled: Vec<_> = scores.iter().map(|x| (0.1 * x).exp() - 7.0).collect();
            let ranked = RankedErrors::new(&errors, &vec![0; items.len()], &[scores, scaled]);
            let found = ranked.statistics(&[1], &THRESHOLDS);
            prop_assert_eq!(&found[0], &found[1]);
        }
    }

    #[test]
    fn without_items_nothing_is_defined() {
        let ranked = RankedErrors::new(&[], &[], &[vec![]]);
        assert_eq!(ranked.statistics(&[], &[1.0]), [RankStatistics { spearman: None, auc: vec![None] }]);
        assert!(ranked.is_empty());
    }
}
