//! Settings of baselines.

use super::error::BaselineError;

/// How baselines are built.
#[derive(Debug, Clone, PartialEq)]
pub struct BaselineSettings {
    /// D-optimality: the largest |coefficient| of a training atom may exceed 1 by this.
    pub tolerance: f64,
    /// D-optimality: maximum number of sweeps over the data.
    pub max_sweeps: usize,
    /// D-optimality: a direction counts as present if a training atom reaches further along it than this times the
    /// largest norm of all (centred) features.
    pub rank_tolerance: f64,
    /// LLPR: η in λ = η tr G / D.
    pub regularisation: f64,
    /// LLPR: factor of the rows of force components in G.
    pub force_weight: f64,
    /// k-nearest neighbour distance: k.
    pub neighbours: usize,
    /// The same: most atoms of the sample for each element.
    pub sample: usize,
    /// The same: random seed of the sample.
    pub seed: u64,
}

impl Default for BaselineSettings {
    fn default() -> Self {
        Self {
            tolerance: 0.01,
            max_sweeps: 20,
            rank_tolerance: 1e-8,
            regularisation: 1e-12,
            force_weight: 1.0,
            neighbours: 5,
            sample: 10_000,
            seed: 42,
        }
    }
}

impl BaselineSettings {
    /// Checks the ranges.
    ///
    /// # Errors
    /// The first value that is out of range.
    pub fn check(&self) -> Result<(), BaselineError> {
        let range = |what, found: f64, fits, expected| match fits {
            true => Ok(()),
            false => Err(BaselineError::Setting { what, found, expected }),
        };
        let Self { tolerance, rank_tolerance, regularisation, force_weight, .. } = *self;
        let positive = |value: f64| value.is_finite() && value > 0.0;
        range("tolerance", tolerance, positive(tolerance), "a number above 0")?;
        let fits = rank_tolerance > 1e-14 && rank_tolerance < 1.0;
        range("rank tolerance", rank_tolerance, fits, "a number between 1e-14 and 1")?;
        range("regularisation", regularisation, positive(regularisation), "a number above 0")?;
        range("force weight", force_weight, positive(force_weight), "a number above 0")?;
        for (what, found) in
            [("sweeps", self.max_sweeps), ("neighbours", self.neighbours), ("sample", self.sample)]
        {
            range(what, found as f64, found > 0, "at least 1")?;
        }
        let (k, sample) = (self.neighbours, self.sample);
        range("neighbours", k as f64, k <= sample, "at most the size of the sample")
    }
}
