//! What a threshold of a grade keeps of a table with one row for each structure (paper, 'Reliability filtering on a
//! Materials Discovery benchmark' and Methods, 'Matbench Discovery evaluation').

mod errors;
mod figure;
mod page;
mod read;
mod text;

use analysis::{FilterStep, GradedRow, Quality, filter_sweep};
use serde::Serialize;

pub use self::figure::draw;
pub use self::page::{PAGE, files};
pub use self::read::{ErrorColumns, InputColumns, read};
pub use self::text::{csv, write};

/// The sweep over thresholds.
#[derive(Debug, Serialize)]
pub struct FilterReport {
    /// Rows of the table that were used.
    pub rows: usize,
    /// Rows left out because a number is missing.
    pub left_out: usize,
    /// Random subsets for each threshold, and their random seed.
    pub draws: u32,
    pub seed: u64,
    /// All rows.
    pub unfiltered: Metrics,
    pub steps: Vec<ThresholdResult>,
}

/// What a threshold keeps.
#[derive(Debug, Serialize)]
pub struct ThresholdResult {
    pub threshold: f64,
    /// Rows with at most this grade.
    pub kept: usize,
    /// Their share of all rows.
    pub share: f64,
    #[serde(flatten)]
    pub metrics: Metrics,
    /// Mean and standard deviation over random subsets of the same size.
    pub random_mean: Metrics,
    pub random_deviation: Metrics,
}

/// Quality of a subset; null where a quantity is not defined.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Metrics {
    pub mean_absolute_error: Option<f64>,
    pub precision: Option<f64>,
    pub recall: Option<f64>,
    pub f1: Option<f64>,
}

impl Metrics {
    /// Names and values, in the order of tables.
    pub fn columns(&self) -> [(&'static str, Option<f64>); 4] {
        [
            ("mean_absolute_error", self.mean_absolute_error),
            ("precision", self.precision),
            ("recall", self.recall),
            ("f1", self.f1),
        ]
    }
}

impl From<Quality> for Metrics {
    fn from(quality: Quality) -> Self {
        let Quality { mean_error, precision, recall, f1 } = quality;
        Self { mean_absolute_error: mean_error, precision, recall, f1 }
    }
}

impl FilterReport {
    /// Filters the rows at each threshold, in ascending order.
    pub fn new(rows: &[GradedRow], left_out: usize, thresholds: &[f64], draws: u32, seed: u64) -> Self {
        let mut thresholds = thresholds.to_vec();
        thresholds.sort_by(f64::total_cmp);
        thresholds.dedup();
        let step = |step: FilterStep| ThresholdResult {
            threshold: step.threshold,
            kept: step.kept,
            share: step.kept as f64 / rows.len().max(1) as f64,
            metrics: step.quality.into(),
            random_mean: step.random_mean.into(),
            random_deviation: step.random_deviation.into(),
        };
        let unfiltered = filter_sweep(rows, &[f64::INFINITY], 0, seed)[0].quality.into();
        let steps = filter_sweep(rows, &thresholds, draws, seed).into_iter().map(step).collect();
        Self { rows: rows.len(), left_out, draws, seed, unfiltered, steps }
    }

    /// Whether the rows have classes.
    pub fn has_classes(&self) -> bool {
        let Metrics { precision, recall, .. } = self.unfiltered;
        precision.is_some() || recall.is_some()
    }
}
