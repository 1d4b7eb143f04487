//! The grades of a batch under one α after the other, without an inverse for each.
//!
//! With the Cholesky factor of the updated covariance, C′ + εI = LLᵀ, and **x** = L⁻¹**δ**
//!
//! σ² = **δ**ᵀ(C′ + εI)⁻¹**δ** = |**x**|².
//!
//! A factor and a triangular solution cost a fraction of an inverse, and are backward stable whatever the directions of
//! the batch (Golub & Van Loan, Matrix Computations, §4.2). What remains is the rounding of C′ itself, some units of
//! rounding times its largest eigenvalue, which does no harm as long as the least is not tiny. Where it could, the
//! trial declines and the caller inverts.

use crate::linear::{cholesky, is_positive, regularised, solve_lower, trace, view};
use crate::rules::CovarianceUpdateKind;
use crate::update::{Batch, CovarianceUpdate, Group};

/// A trial is trusted if the estimated relative error of its least eigenvalue is below this.
const TRUSTED_ERROR: f64 = 1e-8;

/// All trials of one batch.
pub struct AlphaScan<'a> {
    batch: &'a Batch,
    combination: CovarianceUpdateKind,
}

impl<'a> AlphaScan<'a> {
    /// The trials of a batch with one way to combine the covariances.
    pub fn new(batch: &'a Batch, combination: CovarianceUpdateKind) -> Self {
        Self { batch, combination }
    }

    /// γ of each atom of the batch after an update with α, `[atoms]`; `None` if this way is not accurate enough.
    pub fn gamma(&self, alpha: f64) -> Option<Vec<f64>> {
        let update = self.combination.with_alpha(alpha);
        let grades: Option<Vec<_>> = self.batch.groups.iter().map(|group| grades(group, update)).collect();
        Some(self.batch.spread(grades?.into_iter()))
    }
}

/// γ of each atom of a group after an update.
fn grades(group: &Group, update: CovarianceUpdate) -> Option<Vec<f64>> {
    let dimension = group.component.dimension();
    let covariance = regularised(&group.updated_covariance(update), dimension);
    let trace = trace(&covariance, dimension);
    if !is_positive(trace) {
        return None;
    }
    let factor = cholesky(&covariance, dimension)?;
    // No pivot is less than the least eigenvalue.
    let least = (0..dimension).map(|k| factor[(k, k)] * factor[(k, k)]).fold(f64::INFINITY, f64::min);
    if trace * f64::EPSILON > TRUSTED_ERROR * least {
        return None;
    }
    let mut solutions = view(&group.deltas, group.atoms.len(), dimension).transpose().to_owned();
    solve_lower(&factor, &mut solutions);
    Some(solutions.col_iter().map(|x| group.grade(x.squared_norm_l2())).collect())
}
