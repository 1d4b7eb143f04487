//! Labels that are being made, and when they will be done.

use serde::Serialize;
use store::{PendingJobs, RunningLabel, Store, StoreError};

use crate::label_cost::CostEstimator;

/// Largest number of labels under way that are read.
pub const MAX_RUNNING: u32 = 100;

/// A label that is being made.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LabelUnderWay {
    /// What is made, by whom, since when.
    #[serde(flatten)]
    pub label: RunningLabel,
    /// How long an attempt that succeeds will take in all, s, from the labels so far. `None` before the first.
    pub expected_seconds: Option<f64>,
}

/// The labels under way, the longest first.
pub async fn read(store: &Store, costs: &CostEstimator) -> Result<Vec<LabelUnderWay>, StoreError> {
    let running = store.running_labels(MAX_RUNNING).await?;
    let progress = |label: RunningLabel| {
        let (seed_structure, formula, atoms) = (label.seed_structure, label.formula.clone(), label.atoms);
        let core_seconds = costs.predict_attempt(&PendingJobs { seed_structure, formula, atoms, jobs: 1 });
        let cores = f64::from(label.cores.unwrap_or(1).max(1));
        LabelUnderWay { expected_seconds: core_seconds.map(|seconds| seconds / cores), label }
    };
    Ok(running.into_iter().map(progress).collect())
}
