//! Mahalanobis distances of many atoms from one component, without their floor: σ² = |W**δ**|², where (C + εI)⁻¹ = WᵀW.
//!
//! With the Cholesky factor C + εI = LLᵀ, W = L⁻¹ is a lower triangle: σ² takes half the operations of **δ**ᵀS**δ**, and is not
//! negative. Eight atoms at a time pass through six rows of W, with their 48 sums in registers.

use faer::linalg::triangular_inverse::invert_lower_triangular;
use faer::{Mat, MatRef, Par};

use crate::linear::{Eigen, LinearError, TRUNCATION, eigen, regularised, view};

/// Rows of W that a panel passes through at once.
const ROWS: usize = 6;
/// Atoms of a panel.
const LANES: usize = 8;

/// **δ** = **z** − **μ** of atoms, in panels of eight atoms: `[panels × D]`. The last panel is filled with zeros.
#[derive(Debug)]
pub(super) struct DeltaPanels {
    atoms: usize,
    numbers: Vec<[f64; LANES]>,
}

impl DeltaPanels {
    /// From the features of atoms, `[atoms × D]`, and a centroid, `[D]`.
    pub fn new(features: &[f64], centroid: &[f64]) -> Self {
        let dimension = centroid.len();
        let atoms = features.len() / dimension;
        let mut numbers = vec![[0.0; LANES]; atoms.div_ceil(LANES) * dimension];
        let panels = numbers.chunks_exact_mut(dimension).zip(features.chunks(LANES * dimension));
        for (panel, features) in panels {
            for (lane, z) in features.chunks_exact(dimension).enumerate() {
                for ((place, z), centre) in panel.iter_mut().zip(z).zip(centroid) {
                    place[lane] = z - centre;
                }
            }
        }
        Self { atoms, numbers }
    }
}

/// W of a component.
#[derive(Debug)]
pub(super) struct InverseFactor {
    dimension: usize,
    /// Six rows at a time, column after column. Behind the last row there are zeros.
    rows: Vec<[f64; ROWS]>,
    /// Number of columns of each six rows: later ones are zero.
    columns: Vec<usize>,
}

impl InverseFactor {
    /// L⁻¹, from the factor L of C + εI = LLᵀ.
    pub fn of_lower(factor: &Mat<f64>) -> Self {
        let dimension = factor.nrows();
        let mut inverse = Mat::zeros(dimension, dimension);
        invert_lower_triangular(inverse.as_mut(), factor.as_ref(), Par::Seq);
        Self::pack(inverse.as_ref(), |last_row| last_row + 1)
    }

    /// w^(−1/2)Uᵀ for C + εI = UwUᵀ, without the eigenvalues that are negligible or, by rounding, negative.
    ///
    /// # Errors
    /// Eigenvalues that do not converge.
    pub fn of_spectrum(covariance: &[f64], dimension: usize) -> Result<Self, LinearError> {
        let matrix = regularised(covariance, dimension);
        let Eigen { values, vectors } = eigen(view(&matrix, dimension, dimension))?;
        let least = TRUNCATION * values.iter().fold(0.0_f64, |largest, value| largest.max(value.abs()));
        let rows = Mat::from_fn(dimension, dimension, |row, column| match values.get(row) {
            Some(&value) if value > least => vectors[(column, row)] / value.sqrt(),
            _ => 0.0,
        });
        Ok(Self::pack(rows.as_ref(), |_| dimension))
    }

    /// `columns` is how many columns are not zero up to a row.
    fn pack(matrix: MatRef<'_, f64>, columns: impl Fn(usize) -> usize) -> Self {
        let dimension = matrix.nrows();
        let mut packed = Self { dimension, rows: Vec::new(), columns: Vec::new() };
        for first in (0..dimension).step_by(ROWS) {
            let rows = ROWS.min(dimension - first);
            let used = columns(first + rows - 1);
            packed.columns.push(used);
            packed.rows.extend((0..used).map(|column| {
                std::array::from_fn(|row| if row < rows { matrix[(first + row, column)] } else { 0.0 })
            }));
        }
        packed
    }

    /// |W**δ**|² of each atom, `[atoms]`.
    ///
    /// An atom's bits do not depend on the other atoms. They depend on whether the processor has fused multiply-add.
    pub fn squared_norms(&self, deltas: &DeltaPanels) -> Vec<f64> {
        let mut out = Vec::with_capacity(deltas.numbers.len().div_ceil(self.dimension) * LANES);
        pulp::Arch::new().dispatch(SquaredNorms { factor: self, panels: &deltas.numbers, out: &mut out });
        out.truncate(deltas.atoms);
        out
    }
}

struct SquaredNorms<'a> {
    factor: &'a InverseFactor,
    panels: &'a [[f64; LANES]],
    out: &'a mut Vec<f64>,
}

impl pulp::WithSimd for SquaredNorms<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let InverseFactor { dimension, rows, columns } = self.factor;
        for panel in self.panels.chunks_exact(*dimension) {
            let mut norms = [0.0; LANES];
            let mut rows = rows.as_slice();
            for &columns in columns {
                let (six, others) = rows.split_at(columns);
                rows = others;
                for sums in products::<S>(six, panel) {
                    norms.iter_mut().zip(sums).for_each(|(norm, sum)| *norm += sum * sum);
                }
            }
            self.out.extend_from_slice(&norms);
        }
    }
}

/// Six elements of W**δ** of each atom of a panel.
#[inline(always)]
fn products<S: pulp::Simd>(rows: &[[f64; ROWS]], panel: &[[f64; LANES]]) -> [[f64; LANES]; ROWS] {
    let mut sums = [[0.0; LANES]; ROWS];
    for (factors, deltas) in rows.iter().zip(panel) {
        for (sums, &factor) in sums.iter_mut().zip(factors) {
            for (sum, &delta) in sums.iter_mut().zip(deltas) {
                // Without an instruction for it, a fused multiply-add is slow.
                *sum = if S::IS_SCALAR { *sum + factor * delta } else { factor.mul_add(delta, *sum) };
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::linear::{dot, pseudo_inverse, regularised_factor};

    /// Numbers in (−1, 1).
    fn numbers(seed: u64, count: usize) -> Vec<f64> {
        let hash = |k: usize| 43_758.545_3 * (12.9898 * k as f64 + 78.233 * seed as f64).sin();
        (1..=count).map(|k| hash(k).fract()).collect()
    }

    /// XᵀX of `rows` random rows: singular if they are fewer than `dimension`.
    fn covariance(seed: u64, dimension: usize, rows: usize) -> Vec<f64> {
        let x = numbers(seed, rows * dimension);
        let entry =
            |k: usize| x.chunks(dimension).map(|row| row[k / dimension] * row[k % dimension]).sum::<f64>();
        (0..dimension * dimension).map(entry).collect()
    }

    proptest! {
        #[test]
        fn norms_are_the_distances_by_the_inverse(
            seed in 0_u64..1000, dimension in 1_usize..40, rows in 0_usize..60, atoms in 1_usize..30,
        ) {
            let covariance = covariance(seed, dimension, rows);
            let inverse = pseudo_inverse(&regularised(&covariance, dimension), dimension).unwrap();
            let (centroid, features) = (numbers(seed + 1, dimension), numbers(seed + 2, atoms * dimension));
            let deltas = DeltaPanels::new(&features, &centroid);
            let lower = regularised_factor(&covariance, dimension).unwrap().unwrap();
            let by_spectrum = InverseFactor::of_spectrum(&covariance, dimension).unwrap();
            for factor in [InverseFactor::of_lower(&lower), by_spectrum] {
                let found = factor.squared_norms(&deltas);
                prop_assert_eq!(found.len(), atoms);
                for (z, found) in features.chunks(dimension).zip(found) {
                    let delta: Vec<f64> = z.iter().zip(&centroid).map(|(z, centre)| z - centre).collect();
                    let product: Vec<f64> = inverse.chunks(dimension).map(|row| dot(row, &delta)).collect();
                    let expected = dot(&delta, &product);
                    // Condition numbers are up to 10⁸.
                    prop_assert!((found - expected).abs() <= 1e-6 * expected, "{} {}", found, expected);
                }
            }
        }

        #[test]
        fn the_bits_of_an_atom_do_not_depend_on_the_others(seed in 0_u64..100, atoms in 1_usize..30) {
            let dimension = 19;
            let lower = regularised_factor(&covariance(seed, dimension, 25), dimension).unwrap().unwrap();
            let (factor, centroid) = (InverseFactor::of_lower(&lower), numbers(seed, dimension));
            let features = numbers(seed + 2, atoms * dimension);
            let together = factor.squared_norms(&DeltaPanels::new(&features, &centroid));
            let alone = features.chunks(dimension).flat_map(|z| factor.squared_norms(&DeltaPanels::new(z, &centroid)));
            prop_assert_eq!(together, alone.collect::<Vec<_>>());
        }
    }

    /// The covariance is far above the regularisation in one direction, and has no factor in floating point.
    #[test]
    fn negligible_directions_do_not_count() {
        let factor = InverseFactor::of_spectrum(&[1e12, 0.0, 0.0, 0.0], 2).unwrap();
        let norms = factor.squared_norms(&DeltaPanels::new(&[2e6, 0.0, 0.0, 5.0], &[0.0, 0.0]));
        assert!((norms[0] - 4.0).abs() < 1e-12 && norms[1] < 1e-12, "{norms:?}");
    }
}
