//! The grades of a batch for one α after another, without an inverse for each.
//!
//! With the Cholesky factor of the updated covariance, C′ + εI = LLᵀ, and **x** = L⁻¹**δ**,
//!
//! σ² = **δ**ᵀ(C′ + εI)⁻¹**δ** = |**x**|².
//!
//! A factorisation and a triangular solve cost a fraction of an inverse and are backward stable for any
//! directions of the batch (Golub & Van Loan, Matrix Computations, §4.2). The rounding error of C′ itself
//! remains: a few units of rounding times its largest eigenvalue, which is harmless unless the smallest
//! eigenvalue is tiny. In that case the trial returns `None` and the caller inverts.

use crate::linear::{cholesky, is_positive, regularised, solve_lower, trace, view};
use crate::rules::CovarianceUpdateKind;
use crate::update::{Batch, CovarianceUpdate, Group};

/// A trial is accepted if the estimated relative error of its smallest eigenvalue is below this.
const TRUSTED_ERROR: f64 = 1e-8;

/// The trials of one batch.
pub struct AlphaScan<'a> {
    batch: &'a Batch,
    combination: CovarianceUpdateKind,
}

impl<'a> AlphaScan<'a> {
    /// Prepares the trials of a batch with this kind of covariance update.
    pub fn new(batch: &'a Batch, combination: CovarianceUpdateKind) -> Self {
        Self { batch, combination }
    }

    /// γ of each atom of the batch after an update with α, `[atoms]`; `None` if this method is not accurate
    /// enough.
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
    // No pivot is smaller than the smallest eigenvalue.
    let least = (0..dimension).map(|k| factor[(k, k)] * factor[(k, k)]).fold(f64::INFINITY, f64::min);
    if trace * f64::EPSILON > TRUSTED_ERROR * least {
        return None;
    }
    let mut solutions = view(&group.deltas, group.atoms.len(), dimension).transpose().to_owned();
    solve_lower(&factor, &mut solutions);
    Some(solutions.col_iter().map(|x| group.grade(x.squared_norm_l2())).collect())
}
