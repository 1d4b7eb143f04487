use atoms::Species;
use calm::{Component, Mixture, Statistics};
use proptest::prelude::*;

use super::*;

fn queued(decision: i64, expected_error: f64) -> QueuedLabel {
    QueuedLabel {
        job: 100 + decision,
        decision,
        priority: 10,
        version: 0,
        expected_error: Some(expected_error),
        completion: Some(0.5),
        core_hours: Some(2.0),
        overtaken: 0,
        features: None,
    }
}

fn decisions(ordered: &[ValuedLabel]) -> Vec<i64> {
    ordered.iter().map(|valued| valued.job - 100).collect()
}

fn species(symbols: &[&str]) -> Vec<Species> {
    symbols.iter().map(|symbol| symbol.parse().unwrap()).collect()
}

/// Features of dimension 2 with the spreads 2 and 1 for aluminium, 1 and 1 for oxygen.
fn scales() -> FeatureScales {
    let component = |variances: [f64; 2], weight: f64| {
        let inverse = vec![variances[0].recip(), 0.0, 0.0, variances[1].recip()];
        let scatter = vec![weight * variances[0], 0.0, 0.0, weight * variances[1]];
        let statistics = Statistics { scatter, count: weight, effective_count: weight };
        Arc::new(Component::new(vec![0.0; 2], inverse, 1.0, Some(statistics)).unwrap())
    };
    // Three environments in one component and one in the other: (3 · 5 + 1) / 4 = 4.
    let aluminium = vec![component([5.0, 1.0], 3.0), component([1.0, 1.0], 1.0)];
    let mixture = Mixture::new(0, vec![aluminium, vec![component([1.0, 1.0], 9.0)]]).unwrap();
    FeatureScales::new(&mixture, &species(&["Al", "O"]))
}

fn features(symbols: &[&str], features: &[f64]) -> MeanFeatures {
    MeanFeatures::new(&species(symbols), features, &scales()).unwrap()
}

#[test]
fn values_are_products_and_priorities_come_first() {
    let mut rows = vec![queued(1, 0.2), queued(2, 0.8), queued(3, 0.4), queued(4, 9.0), queued(5, 0.8)];
    rows[3].priority = 0;
    (rows[2].completion, rows[2].core_hours) = (Some(0.9), Some(0.5));
    let ordered = order(&rows, &[]);
    assert_eq!(decisions(&ordered), [3, 2, 5, 1, 4], "equal values are in the order found");
    assert!((ordered[0].value - 0.4 * 0.9 / 0.5).abs() < 1e-12, "{:?}", ordered[0]);
    let factors = ordered[1].factors;
    assert_eq!((factors.expected_error, factors.completion, factors.core_hours), (0.8, 0.5, 2.0));
    assert_eq!((factors.diversity, factors.age, factors.overtaken), (1.0, Some(1.0), 0));
}

#[test]
fn what_is_unknown_counts_as_the_mean_of_the_others() {
    let mut rows = vec![queued(1, 0.2), queued(2, 0.6), queued(3, 1.0)];
    (rows[1].expected_error, rows[1].completion) = (None, Some(f64::NAN));
    rows[1].core_hours = Some(0.0);
    let ordered = order(&rows, &[]);
    let second = ordered.iter().find(|valued| valued.job == 102).unwrap().factors;
    assert_eq!((second.expected_error, second.completion, second.core_hours), (0.6, 0.5, 2.0));
    let unknown: Vec<_> = rows
        .iter()
        .map(|row| QueuedLabel { expected_error: None, completion: None, core_hours: None, ..row.clone() })
        .collect();
    let ordered = order(&unknown, &[]);
    assert_eq!((decisions(&ordered), ordered[0].value), (vec![1, 2, 3], 1.0));
}

#[test]
fn what_is_covered_comes_later() {
    let with = |row: QueuedLabel, x: f64| {
        let features = features(&["Al", "Al"], &[x, 0.0, x, 0.0]);
        QueuedLabel { features: Some(Arc::new(features)), ..row }
    };
    // Two alike of the largest values, one that has a label already, and one like no other.
    let rows = vec![
        with(queued(1, 1.0), 0.0),
        with(queued(2, 0.9), 1e-3),
        with(queued(3, 0.5), 90.0),
        with(queued(4, 0.8), 50.0),
    ];
    let covering = |decision: i64, version: u32, x: f64| {
        let features = Arc::new(features(&["Al", "Al"], &[x, 0.0, x, 0.0]));
        CoveringLabel { decision, version, features }
    };
    let ordered = order(&rows, &[covering(9, 0, 50.0)]);
    assert_eq!(decisions(&ordered), [1, 3, 2, 4]);
    assert!(ordered[2].factors.diversity < 1e-5 && ordered[3].factors.diversity == 0.0);
    // Labels of other versions, and a structure's own label, cover nothing.
    let ordered = order(&rows, &[covering(9, 1, 50.0), covering(4, 0, 50.0)]);
    assert_eq!(decisions(&ordered), [1, 4, 3, 2]);
    assert!(ordered.is_sorted_by(|a, b| a.value >= b.value));
}

#[test]
fn an_overtaken_structure_is_worth_more_and_is_next_in_the_end() {
    let mut rows = vec![queued(1, 1e-6), queued(2, 1.0), queued(3, 1.0), queued(4, 1e-6)];
    (rows[0].overtaken, rows[3].overtaken, rows[2].overtaken) = (8, 8, 4);
    let ordered = order(&rows, &[]);
    // m N = 8: the first and the last are next in the order found; half way there the value doubles.
    assert_eq!(decisions(&ordered), [1, 4, 3, 2]);
    assert_eq!((ordered[0].value, ordered[0].factors.age), (OVERDUE, None));
    assert_eq!(ordered[2].factors.age, Some(2.0));
}

/// ½ n d² = ½ · 2 · (1/1) · 1 · ½ · ((2/2)² + 1²) = 1.
#[test]
fn novelty_is_half_for_a_thermal_difference() {
    let (one, other) = (features(&["Al", "Al"], &[0.0; 4]), features(&["Al", "Al"], &[2.0, 1.0, 2.0, 1.0]));
    assert!((one.novelty(&other) - 0.5).abs() < 1e-12, "{}", one.novelty(&other));
    assert_eq!((one.novelty(&one), other.novelty(&one)), (0.0, one.novelty(&other)));
    let oxide = features(&["Al", "O"], &[0.0; 4]);
    assert_eq!((one.novelty(&oxide), oxide.novelty(&one)), (1.0, 1.0));
    let unknown = species(&["Al", "Fe"]);
    assert_eq!(MeanFeatures::new(&unknown, &[0.0; 4], &scales()), None);
    assert_eq!(MeanFeatures::new(&species(&["Al", "Al"]), &[0.0; 3], &scales()), None);
    assert_eq!(MeanFeatures::new(&[], &[], &scales()), None);
}

/// A queue whose order is computed again after some labels, as in a campaign.
struct SimulatedQueue {
    waiting: Vec<QueuedLabel>,
    values: BTreeMap<i64, f64>,
    finished: Vec<i64>,
}

impl SimulatedQueue {
    fn overtaken(&self, decision: i64) -> u64 {
        self.finished.iter().filter(|finished| **finished > decision).count() as u64
    }

    fn compute_values(&mut self) {
        let overtaken: Vec<u64> = self.waiting.iter().map(|row| self.overtaken(row.decision)).collect();
        self.waiting.iter_mut().zip(overtaken).for_each(|(row, overtaken)| row.overtaken = overtaken);
        self.values = order(&self.waiting, &[]).iter().map(|valued| (valued.job, valued.value)).collect();
    }

    /// Labels the next structure as the store leases them. Returns how often it was overtaken.
    fn label(&mut self) -> Option<u64> {
        let value = |row: &QueuedLabel| self.values.get(&row.job).copied().unwrap_or(-1.0);
        let places = 0..self.waiting.len();
        let next = places.max_by(|a, b| {
            let (a, b) = (&self.waiting[*a], &self.waiting[*b]);
            value(a).total_cmp(&value(b)).then(b.decision.cmp(&a.decision))
        })?;
        let row = self.waiting.remove(next);
        let overtaken = self.overtaken(row.decision);
        self.finished.push(row.decision);
        Some(overtaken)
    }
}

proptest! {
    /// No structure is overtaken more often than twice the length of the queue, and between two computations of the order,
    /// however large the values of later structures are.
    #[test]
    fn nothing_starves(
        arrivals in prop::collection::vec((0..4_usize, -6.0..6.0_f64), 1..300),
        longest in 1..20_usize,
        interval in 1..6_usize,
    ) {
        let mut queue = SimulatedQueue { waiting: Vec::new(), values: BTreeMap::new(), finished: Vec::new() };
        let mut decision = 0;
        for (round, (number, exponent)) in arrivals.iter().enumerate() {
            for k in 0..*number {
                if queue.waiting.len() < longest {
                    decision += 1;
                    queue.waiting.push(queued(decision, 10_f64.powf(exponent + k as f64)));
                }
            }
            if round % interval == 0 {
                queue.compute_values();
            }
            if let Some(overtaken) = queue.label() {
                let most = MAX_OVERTAKEN * longest as u64 + interval as u64;
                prop_assert!(overtaken <= most, "{} of {}", overtaken, most);
            }
        }
    }

    #[test]
    fn the_order_has_every_structure_once_and_does_not_depend_on_the_order_of_rows(
        errors in prop::collection::vec((0.0..10.0_f64, 0..9_u64, -3.0..3.0_f64, 0..2_i32), 0..30),
    ) {
        let row = |(number, (error, overtaken, x, priority)): (usize, &(f64, u64, f64, i32))| {
            let features = Some(Arc::new(features(&["Al"], &[*x, -x])));
            QueuedLabel { overtaken: *overtaken, priority: *priority, features, ..queued(number as i64, *error) }
        };
        let rows: Vec<_> = errors.iter().enumerate().map(row).collect();
        let ordered = order(&rows, &[]);
        let mut all = decisions(&ordered);
        all.sort_unstable();
        prop_assert_eq!(all, (0..rows.len() as i64).collect::<Vec<_>>());
        let reversed: Vec<_> = rows.iter().rev().cloned().collect();
        prop_assert_eq!(decisions(&order(&reversed, &[])), decisions(&ordered));
        for priority in 0..2 {
            let of_priority = |valued: &&ValuedLabel| rows[(valued.job - 100) as usize].priority == priority;
            let values: Vec<f64> = ordered.iter().filter(of_priority).map(|valued| valued.value).collect();
            prop_assert!(values.is_sorted_by(|a, b| a >= b), "{:?}", values);
            prop_assert!(values.iter().all(|value| value.is_finite() && *value >= 0.0));
        }
    }
}
