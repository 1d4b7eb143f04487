//! What a model is read for.

use super::radial::RadialPath;
use super::vector::{Number, Vector};

/// What a model is read for.
#[derive(Clone, Copy, Debug)]
pub(super) struct ReadOptions {
    pub radial: RadialPath,
    /// Whether derivatives with respect to weights will be computed.
    pub training: bool,
}

/// The error of tables in training, which are made anew with every update, relative to the largest value.
const TRAINING_TABLE_ERROR: f64 = 1e-7;

impl ReadOptions {
    /// The largest error of tables of radial functions; `None` without tables.
    pub fn table_error<V: Vector>(&self) -> Option<f64> {
        let evaluation = V::Number::TABLE_ERROR;
        let error = if self.training { TRAINING_TABLE_ERROR.max(evaluation) } else { evaluation };
        (self.radial == RadialPath::Table).then_some(error)
    }
}
