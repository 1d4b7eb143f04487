//! Cost of the labels of a campaign, so far and expected.

use std::collections::HashMap;

use analysis::{CostModel, CostPredictors, MeasuredCost, Predicted};
use serde::Serialize;
use store::{LabelCost, PendingJobs, Protocol, Store, StoreError};
use wire::ContentHash;

/// Number of labels that the cost model is fitted to: the newest.
const MAX_SAMPLES: u32 = 1_000;

/// Seconds in an hour.
pub const SECONDS_PER_HOUR: f64 = 3600.0;

/// Core-hours: the expected value and a 90 % interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CoreHours {
    /// Expected value.
    pub expected: f64,
    /// Lower end of the 90 % interval.
    pub low: f64,
    /// Upper end of the 90 % interval.
    pub high: f64,
}

/// Cost of the label queue.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct QueueCost {
    /// Jobs that are queued or leased.
    pub unfinished: u64,
    /// Labels whose cost was measured.
    pub measured: usize,
    /// Total cost ÷ cost of the successful attempts.
    pub overhead: f64,
    /// Expected cost of the unfinished jobs, failed attempts included. `None` before the first label.
    pub remaining: Option<CoreHours>,
    /// Cores of the running attempts.
    pub cores: u64,
    /// Hours until the queue is empty at the current rate, if nothing is added.
    pub hours_left: Option<f64>,
}

/// Predicts the cost of labels of one protocol.
pub struct CostEstimator {
    model: Option<CostModel>,
    /// Size of the newest label of each seed structure and formula.
    sizes: HashMap<(u32, String), CostPredictors>,
    /// See [`QueueCost::overhead`].
    overhead: f64,
}

impl CostEstimator {
    /// Fits a model to the labels of `protocol`.
    pub async fn from_store(store: &Store, protocol: ContentHash) -> Result<Self, StoreError> {
        let costs = store.label_costs(protocol, MAX_SAMPLES).await?;
        let measured: Vec<_> = costs.iter().map(measured).collect();
        let mut sizes = HashMap::new();
        for cost in costs.iter().rev() {
            sizes.insert((cost.seed_structure, cost.formula.clone()), size(cost));
        }
        let work = store.label_usage().await?;
        let overhead = work.core_seconds.zip(work.label_core_seconds.filter(|brought| *brought > 0.0));
        let overhead = overhead.map_or(1.0, |(all, brought)| (all / brought).max(1.0));
        Ok(Self { model: CostModel::fit(&measured, None), sizes, overhead })
    }

    /// Uses an existing model.
    pub fn from_model(model: Option<CostModel>) -> Self {
        Self { model, sizes: HashMap::new(), overhead: 1.0 }
    }

    /// Number of labels that the model was fitted to.
    pub fn measured(&self) -> usize {
        self.model.as_ref().map_or(0, CostModel::labels)
    }

    /// Expected total cost of labels of these sizes, each with its number.
    pub fn predict(&self, sizes: impl IntoIterator<Item = (CostPredictors, u64)>) -> Option<CoreHours> {
        let predicted = self.model.as_ref()?.predict_all(sizes)?;
        Some(CoreHours::from_core_seconds(predicted, self.overhead))
    }

    /// Expected cost of one label job, failed attempts included. `None` before the first label, or if its size is unknown.
    pub fn predict_job(&self, waiting: &PendingJobs) -> Option<CoreHours> {
        self.predict([(self.size_of(waiting), 1)])
    }

    /// Expected core-seconds of a successful attempt at a job.
    pub fn predict_attempt(&self, waiting: &PendingJobs) -> Option<f64> {
        let predicted = self.model.as_ref()?.predict_all([(self.size_of(waiting), 1)])?;
        Some(predicted.core_seconds)
    }

    /// A job has the size of the newest label of its seed structure and formula. Otherwise only the number of atoms
    /// is known.
    fn size_of(&self, waiting: &PendingJobs) -> CostPredictors {
        let known = self.sizes.get(&(waiting.seed_structure, waiting.formula.clone()));
        let other = self.sizes.values().next();
        known.copied().unwrap_or_else(|| {
            let atoms = f64::from(waiting.atoms);
            // Methods without electrons have no k-point mesh either. For the others the size is unknown, which NaN
            // tells the model.
            let electrons = other.and_then(|other| other.electrons).map(|_| f64::NAN);
            CostPredictors { atoms, electrons, k_points: 1.0 }
        })
    }
}

/// Cost of the jobs that have no label of `protocol` yet.
pub async fn queue_cost(
    store: &Store,
    protocol: ContentHash,
    costs: &CostEstimator,
) -> Result<QueueCost, StoreError> {
    let (waiting, work) = (store.waiting_jobs(protocol).await?, store.label_usage().await?);
    let remaining = costs.predict(waiting.iter().map(|waiting| (costs.size_of(waiting), waiting.jobs)));
    let hours_left = remaining.filter(|_| work.cores > 0).map(|hours| hours.expected / work.cores as f64);
    Ok(QueueCost {
        unfinished: waiting.iter().map(|waiting| waiting.jobs).sum(),
        measured: costs.measured(),
        overhead: costs.overhead,
        remaining,
        cores: work.cores,
        hours_left,
    })
}

/// Expected cost of making labels again.
pub struct RelabelCost {
    /// `None` before the first label.
    pub hours: Option<CoreHours>,
    /// Labels whose cost was measured.
    pub measured: usize,
    /// Name of the protocol of the measured labels.
    pub protocol: String,
}

/// Expected cost of labelling these structures, from labels of the protocol in force or, before it has any, of the
/// newest protocol that has.
pub async fn relabel_cost(
    store: &Store,
    in_force: &Protocol,
    structures: &[PendingJobs],
) -> Result<RelabelCost, StoreError> {
    let mut protocol = in_force.clone();
    let mut costs = CostEstimator::from_store(store, protocol.hash).await?;
    for earlier in store.protocols().await?.into_iter().rev() {
        if costs.measured() == 0 {
            costs = CostEstimator::from_store(store, earlier.hash).await?;
            protocol = earlier;
        }
    }
    let hours = costs.predict(structures.iter().map(|waiting| (costs.size_of(waiting), waiting.jobs)));
    Ok(RelabelCost { hours, measured: costs.measured(), protocol: protocol.name })
}

impl CoreHours {
    /// The cost times a factor.
    pub fn scaled(self, factor: f64) -> Self {
        Self { expected: factor * self.expected, low: factor * self.low, high: factor * self.high }
    }

    /// Converts core-seconds, times a factor.
    pub fn from_core_seconds(predicted: Predicted, factor: f64) -> Self {
        let hours = |seconds: f64| factor * seconds / SECONDS_PER_HOUR;
        Self {
            expected: hours(predicted.core_seconds),
            low: hours(predicted.low),
            high: hours(predicted.high),
        }
    }
}

fn size(cost: &LabelCost) -> CostPredictors {
    CostPredictors {
        atoms: cost.atoms.into(),
        electrons: cost.electrons.filter(|electrons| *electrons > 0.0),
        k_points: cost.k_points.unwrap_or(1).into(),
    }
}

fn measured(cost: &LabelCost) -> MeasuredCost {
    MeasuredCost { size: size(cost), core_seconds: cost.core_seconds }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn core_seconds_become_hours() {
        let predicted = Predicted { core_seconds: 3600.0, low: 1800.0, high: 9000.0 };
        let expected = CoreHours { expected: 2.0, low: 1.0, high: 5.0 };
        assert_eq!(CoreHours::from_core_seconds(predicted, 2.0), expected);
    }
}
