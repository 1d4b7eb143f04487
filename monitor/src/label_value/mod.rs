//! What to label first: the value of each queued structure, and the order that follows.
//!
//! The value of a structure is
//!
//! ```text
//! expected error × probability that the calculation completes ÷ expected cost × diversity × age
//! ```
//!
//! in eV/Å per core-hour. What is unknown of one structure counts as the mean of the others. Values order jobs of equal
//! priority only. [`order()`] is a pure function; [`read`] gives it the rows.

mod mean_features;
mod read;

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

pub use mean_features::{FeatureScales, MeanFeatures};
pub use read::{LabelOrderReader, OrderInputs};

/// A structure that later ones have overtaken this many times as often as there are structures in the queue is next, whatever its
/// value.
///
/// A structure that finds at most N structures of its priority in the queue, as long as it waits, gets its label after at most
/// (1 + `MAX_OVERTAKEN`) N labels, and those that are made before the order is computed again: N structures were found before it.
pub const MAX_OVERTAKEN: u64 = 2;

/// The value of a structure that is next for its age.
pub const OVERDUE: f64 = f64::MAX;

/// A structure that waits for its label.
#[derive(Clone, Debug)]
pub struct QueuedLabel {
    /// Id of its job.
    pub job: i64,
    /// Sequence number of the decision on it: smaller ones were found earlier.
    pub decision: i64,
    /// Priority of its job; higher first.
    pub priority: i32,
    /// Version of the potential of its walk.
    pub version: u32,
    /// Mean expected force error of its atoms, eV/Å.
    pub expected_error: Option<f64>,
    /// Probability that its calculation completes.
    pub completion: Option<f64>,
    /// Expected cost, core-hours.
    pub core_hours: Option<f64>,
    /// Number of structures of the same priority that were found later and are finished.
    pub overtaken: u64,
    /// Its mean features.
    pub features: Option<Arc<MeanFeatures>>,
}

/// A structure that has its label, or is about to.
#[derive(Clone, Debug)]
pub struct CoveringLabel {
    /// Sequence number of the decision on it.
    pub decision: i64,
    /// Version of the potential of its walk: features of different versions cannot be compared.
    pub version: u32,
    /// Its mean features.
    pub features: Arc<MeanFeatures>,
}

/// The factors of a value.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ValueFactors {
    /// Mean expected force error of its atoms, eV/Å; 1 if that is unknown of all structures.
    pub expected_error: f64,
    /// Probability that the calculation completes; 1 likewise.
    pub completion: f64,
    /// Expected cost, core-hours; 1 likewise.
    pub core_hours: f64,
    /// What labels, and structures before it in the queue, leave of its value: 0 to 1.
    pub diversity: f64,
    /// Factor for its age, 1 or more; `None` if it is next for its age.
    pub age: Option<f64>,
    /// Number of structures of the same priority that were found later and are finished.
    pub overtaken: u64,
}

/// A queued structure with its value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ValuedLabel {
    /// Id of its job.
    pub job: i64,
    /// Its value, eV/Å per core-hour; [`OVERDUE`] if it is next for its age.
    pub value: f64,
    /// The factors of the value.
    pub factors: ValueFactors,
}

/// The value of each queued structure, in the order in which they are labelled.
///
/// The order is greedy: the structure of the largest value is next, and covers others of the same version like one that has its
/// label. Values of one priority fall along the order, because what is covered stays so.
pub fn order(rows: &[QueuedLabel], covering: &[CoveringLabel]) -> Vec<ValuedLabel> {
    let known = KnownFactors::of(rows);
    let mut by_priority: BTreeMap<Reverse<i32>, Vec<&QueuedLabel>> = BTreeMap::new();
    for row in rows {
        by_priority.entry(Reverse(row.priority)).or_default().push(row);
    }
    let mut groups: Vec<Vec<WaitingLabel<'_>>> = Vec::with_capacity(by_priority.len());
    for rows in by_priority.into_values() {
        let number = rows.len() as u64;
        groups.push(rows.into_iter().map(|row| WaitingLabel::new(row, &known, number, covering)).collect());
    }
    set_unknown_diversities(&mut groups);
    let mut ordered = Vec::with_capacity(rows.len());
    for group in 0..groups.len() {
        while let Some(place) = next(&groups[group]) {
            let best = groups[group].swap_remove(place);
            ordered.push(best.valued());
            if let Some(label) = best.covering() {
                groups[group..].iter_mut().flatten().for_each(|waiting| waiting.cover(&label));
            }
        }
    }
    ordered
}

/// Structures whose features are unknown, or those of another version of the potential than the scales, get the mean diversity of the
/// others: 1 would put them before all.
fn set_unknown_diversities(groups: &mut [Vec<WaitingLabel<'_>>]) {
    let is_known = |waiting: &&WaitingLabel<'_>| waiting.row.features.is_some();
    let known = groups.iter().flatten().filter(is_known).map(|waiting| waiting.factors.diversity);
    let diversity = mean(known);
    let unknown = groups.iter_mut().flatten().filter(|waiting| waiting.row.features.is_none());
    unknown.for_each(|waiting| waiting.factors.diversity = diversity);
}

/// The place of the largest value; of equal ones, of the one that was found first.
fn next(waiting: &[WaitingLabel<'_>]) -> Option<usize> {
    let best = waiting.iter().enumerate().max_by(|(_, a), (_, b)| {
        let by_value = a.value().total_cmp(&b.value());
        by_value.then(b.row.decision.cmp(&a.row.decision))
    });
    best.map(|(place, _)| place)
}

/// Means of what is known, for structures of which it is not.
struct KnownFactors {
    expected_error: f64,
    completion: f64,
    core_hours: f64,
}

impl KnownFactors {
    fn of(rows: &[QueuedLabel]) -> Self {
        Self {
            expected_error: mean(rows.iter().filter_map(|row| usable(row.expected_error))),
            completion: mean(rows.iter().filter_map(|row| usable(row.completion))),
            core_hours: mean(rows.iter().filter_map(|row| positive(row.core_hours))),
        }
    }
}

/// 1 without values.
fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (number, sum) = values.fold((0.0, 0.0), |(number, sum), value| (number + 1.0, sum + value));
    if number > 0.0 && sum > 0.0 { sum / number } else { 1.0 }
}

fn usable(value: Option<f64>) -> Option<f64> {
    value.filter(|value| value.is_finite() && *value >= 0.0)
}

fn positive(value: Option<f64>) -> Option<f64> {
    value.filter(|value| value.is_finite() && *value > 0.0)
}

/// A structure whose place in the order is not known yet.
struct WaitingLabel<'a> {
    row: &'a QueuedLabel,
    factors: ValueFactors,
}

impl<'a> WaitingLabel<'a> {
    /// `number` structures of its priority are in the queue.
    fn new(row: &'a QueuedLabel, known: &KnownFactors, number: u64, covering: &[CoveringLabel]) -> Self {
        let factors = ValueFactors {
            expected_error: usable(row.expected_error).unwrap_or(known.expected_error),
            completion: usable(row.completion).unwrap_or(known.completion),
            core_hours: positive(row.core_hours).unwrap_or(known.core_hours),
            diversity: 1.0,
            age: age(row.overtaken, number),
            overtaken: row.overtaken,
        };
        let mut waiting = Self { row, factors };
        covering.iter().for_each(|label| waiting.cover(label));
        waiting
    }

    fn value(&self) -> f64 {
        let ValueFactors { expected_error, completion, core_hours, diversity, age, .. } = self.factors;
        let Some(age) = age else { return OVERDUE };
        // Below the value of structures that are next for their age.
        (expected_error * completion / core_hours * diversity * age).min(0.5 * OVERDUE)
    }

    /// Lowers the diversity by what a label covers. A structure does not cover itself: it may have a label that is made again.
    fn cover(&mut self, label: &CoveringLabel) {
        let Some(features) = self.row.features.as_ref() else { return };
        if label.version == self.row.version && label.decision != self.row.decision {
            self.factors.diversity = self.factors.diversity.min(features.novelty(&label.features));
        }
    }

    /// Covers others like a label from now on.
    fn covering(&self) -> Option<CoveringLabel> {
        let features = self.row.features.clone()?;
        Some(CoveringLabel { decision: self.row.decision, version: self.row.version, features })
    }

    fn valued(&self) -> ValuedLabel {
        ValuedLabel { job: self.row.job, value: self.value(), factors: self.factors }
    }
}

/// 1 / (1 − o / (m N)) for a structure that was overtaken o times in a queue of N, with m = [`MAX_OVERTAKEN`]; `None` from
/// o = m N on.
fn age(overtaken: u64, number: u64) -> Option<f64> {
    let most = MAX_OVERTAKEN * number.max(1);
    (overtaken < most).then(|| 1.0 / (1.0 - overtaken as f64 / most as f64))
}

#[cfg(test)]
mod tests;
