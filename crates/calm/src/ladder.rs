//! The grades of a batch for many α at the cost of hardly more than one.
//!
//! With A = C + εI and B = C_batch + εI the convex trial is (1 − α)A + αB; with B = C_batch the additive one is
//! A + αB. Let A = LLᵀ and L⁻¹BL⁻ᵀ = QΛQᵀ. Then both are LQ(a + αΛ)QᵀLᵀ, a = 1 − α or 1, and with
//! **y** = QᵀL⁻¹**δ**
//!
//! σ² = Σ_i y_i² / (a + αλ_i)   for every α.
//!
//! This is the simultaneous diagonalisation of a symmetric-definite pencil (Golub & Van Loan, Matrix Computations,
//! §8.7). It is exact but for rounding: the eigenvalues λ carry an absolute error of some units of rounding times
//! the largest, which does no harm as long as the smallest a + αλ_i is not tiny. Where it could (in practice α = 1
//! in the convex case, whose a is zero), the trial declines and the caller inverts directly.

use crate::linear::{
    Eigen, REGULARISATION, TRUNCATION, cholesky, eigen, product, regularised, solve_lower, view,
};
use crate::rules::Combination;
use crate::update::{Batch, Group};

/// A trial is trusted if the estimated relative error of its least denominator is below this.
const TRUSTED_ERROR: f64 = 1e-8;

/// All trials of one batch.
pub struct TrialLadder<'a> {
    batch: &'a Batch,
    pencils: Option<Vec<Pencil>>,
    combination: Combination,
}

/// The diagonalised pencil of one component and the batch's atoms in its coordinates.
struct Pencil {
    /// λ, `[D]`.
    eigenvalues: Vec<f64>,
    /// y², `[atoms × D]`.
    squares: Vec<f64>,
}

impl<'a> TrialLadder<'a> {
    /// Factorises and diagonalises once for each touched component.
    pub fn new(batch: &'a Batch, combination: Combination) -> Self {
        let pencils = batch.groups.iter().map(|group| Pencil::new(group, combination)).collect();
        Self { batch, pencils, combination }
    }

    /// γ of each atom of the batch after an update with α, `[atoms]`; `None` if this way is not accurate enough.
    pub fn gamma(&self, alpha: f64) -> Option<Vec<f64>> {
        let rest = match self.combination {
            Combination::Convex => 1.0 - alpha,
            Combination::Additive => 1.0,
        };
        let pencils = self.pencils.as_ref()?;
        let grades = self.batch.groups.iter().zip(pencils).map(|(group, pencil)| {
            let squared = pencil.squared_distances(rest, alpha)?;
            Some(squared.map(|squared| group.grade(squared)).collect())
        });
        let grades: Option<Vec<Vec<f64>>> = grades.collect();
        Some(self.batch.spread(grades?.into_iter()))
    }
}

impl Pencil {
    fn new(group: &Group, combination: Combination) -> Option<Self> {
        let dimension = group.component.dimension();
        let old = regularised(&group.old, dimension);
        let other = match combination {
            Combination::Convex => regularised(&group.batch, dimension),
            Combination::Additive => group.batch.clone(),
        };
        // Beyond this the pseudo-inverse could begin to drop eigenvalues, which the pencil does not.
        let trace = |matrix: &[f64]| matrix.iter().step_by(dimension + 1).sum::<f64>();
        if TRUNCATION * (trace(&old) + trace(&other)) >= REGULARISATION {
            return None;
        }
        let factor = cholesky(&old, dimension)?;
        let mut half = view(&other, dimension, dimension).to_owned();
        solve_lower(&factor, &mut half);
        let mut whole = half.transpose().to_owned();
        solve_lower(&factor, &mut whole);
        let Eigen { values, vectors } = eigen(whole.as_ref()).ok()?;
        let mut deltas = view(&group.deltas, group.atoms.len(), dimension).transpose().to_owned();
        solve_lower(&factor, &mut deltas);
        let coordinates = product(vectors.transpose(), deltas.as_ref());
        let squares = coordinates.col_iter().flat_map(|column| column.iter().map(|y| y * y)).collect();
        Some(Self { eigenvalues: values, squares })
    }

    /// Σ_i y_i² / (a + αλ_i) for each atom.
    fn squared_distances(&self, rest: f64, alpha: f64) -> Option<impl Iterator<Item = f64>> {
        let weights: Vec<f64> = self.eigenvalues.iter().map(|value| rest + alpha * value.max(0.0)).collect();
        let least = weights.iter().copied().fold(f64::INFINITY, f64::min);
        let largest = self.eigenvalues.iter().copied().fold(0.0, f64::max);
        if alpha * largest * f64::EPSILON > TRUSTED_ERROR * least {
            return None;
        }
        let atoms = self.squares.chunks_exact(weights.len());
        Some(
            atoms.map(move |squares| {
                squares.iter().zip(&weights).map(|(square, weight)| square / weight).sum()
            }),
        )
    }
}
