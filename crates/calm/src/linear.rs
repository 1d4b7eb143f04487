//! Dense symmetric linear algebra on row-major slices, sequential throughout.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::factor::{LltRegularization, cholesky_in_place, cholesky_in_place_scratch};
use faer::linalg::cholesky::llt::inverse::{inverse, inverse_scratch};
use faer::linalg::evd::{ComputeEigenvectors, self_adjoint_evd, self_adjoint_evd_scratch};
use faer::linalg::matmul::matmul;
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::{Accum, Mat, MatRef, Par};

/// Added to the diagonal of every covariance before it is inverted (paper, Methods): ε = 10⁻⁶.
pub const REGULARISATION: f64 = 1e-6;

/// The pseudo-inverse drops eigenvalues with |w| ≤ this times max |w|.
pub const TRUNCATION: f64 = 1e-15;

/// A matrix for which the linear algebra failed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LinearError {
    /// The slice is not a square matrix of the stated dimension.
    #[error("a {dimension} × {dimension} matrix needs {} numbers, found {found}", dimension * dimension)]
    Size {
        /// Expected rows and columns.
        dimension: usize,
        /// Numbers found.
        found: usize,
    },
    /// An element is infinite or not a number.
    #[error("the matrix has an element that is not finite (row {row}, column {column})")]
    NotFinite {
        /// Row of the first such element.
        row: usize,
        /// Its column.
        column: usize,
    },
    /// The eigenvalue iteration failed.
    #[error("the eigenvalues of a {dimension} × {dimension} matrix did not converge")]
    NoConvergence {
        /// Rows and columns.
        dimension: usize,
    },
    /// A matrix that should be positive definite is not.
    #[error("a {dimension} × {dimension} matrix is not positive definite")]
    NotPositive {
        /// Rows and columns.
        dimension: usize,
    },
}

/// Eigenvalues (ascending) and eigenvectors (columns) of a symmetric matrix.
pub(crate) struct Eigen {
    pub values: Vec<f64>,
    pub vectors: Mat<f64>,
}

/// A row-major slice as a faer view; the order is irrelevant for a symmetric matrix.
pub(crate) fn view(matrix: &[f64], rows: usize, columns: usize) -> MatRef<'_, f64> {
    MatRef::from_row_major_slice(matrix, rows, columns)
}

/// The product of two matrices.
pub(crate) fn product(left: MatRef<'_, f64>, right: MatRef<'_, f64>) -> Mat<f64> {
    let mut out = Mat::zeros(left.nrows(), right.ncols());
    matmul(&mut out, Accum::Replace, left, right, 1.0, Par::Seq);
    out
}

/// The symmetric part (M + Mᵀ)/2 as a row-major matrix: exactly symmetric.
pub(crate) fn symmetrised(matrix: MatRef<'_, f64>) -> Vec<f64> {
    let dimension = matrix.nrows();
    let mut out = Vec::with_capacity(dimension * dimension);
    for row in 0..dimension {
        out.extend((0..dimension).map(|column| 0.5 * (matrix[(row, column)] + matrix[(column, row)])));
    }
    out
}

/// Eigendecomposition of a symmetric matrix; reads the lower triangle.
pub(crate) fn eigen(matrix: MatRef<'_, f64>) -> Result<Eigen, LinearError> {
    let dimension = matrix.nrows();
    let mut values = faer::diag::Diag::zeros(dimension);
    let mut vectors = Mat::zeros(dimension, dimension);
    let scratch =
        self_adjoint_evd_scratch::<f64>(dimension, ComputeEigenvectors::Yes, Par::Seq, Default::default());
    self_adjoint_evd(
        matrix,
        values.as_mut(),
        Some(vectors.as_mut()),
        Par::Seq,
        MemStack::new(&mut MemBuffer::new(scratch)),
        Default::default(),
    )
    .map_err(|_| LinearError::NoConvergence { dimension })?;
    let values = values.column_vector().iter().copied().collect();
    Ok(Eigen { values, vectors })
}

/// The eigenvalues of a symmetric matrix, ascending.
pub(crate) fn eigenvalues(matrix: MatRef<'_, f64>) -> Result<Vec<f64>, LinearError> {
    let dimension = matrix.nrows();
    let mut values = faer::diag::Diag::zeros(dimension);
    let scratch =
        self_adjoint_evd_scratch::<f64>(dimension, ComputeEigenvectors::No, Par::Seq, Default::default());
    let memory = &mut MemBuffer::new(scratch);
    self_adjoint_evd(matrix, values.as_mut(), None, Par::Seq, MemStack::new(memory), Default::default())
        .map_err(|_| LinearError::NoConvergence { dimension })?;
    Ok(values.column_vector().iter().copied().collect())
}

/// The factor L of A = LLᵀ, or `None` when A is not positive definite in floating point.
pub(crate) fn cholesky(matrix: &[f64], dimension: usize) -> Option<Mat<f64>> {
    let mut factor = view(matrix, dimension, dimension).to_owned();
    let scratch = cholesky_in_place_scratch::<f64>(dimension, Par::Seq, Default::default());
    let factorised = cholesky_in_place(
        factor.as_mut(),
        LltRegularization::default(),
        Par::Seq,
        MemStack::new(&mut MemBuffer::new(scratch)),
        Default::default(),
    );
    factorised.is_ok().then_some(factor)
}

/// Replaces X with L⁻¹X.
pub(crate) fn solve_lower(factor: &Mat<f64>, right: &mut Mat<f64>) {
    solve_lower_triangular_in_place(factor.as_ref(), right.as_mut(), Par::Seq);
}

/// Symmetric pseudo-inverse Σ_i u_i u_iᵀ / w_i over the eigenpairs with |w_i| > 10⁻¹⁵ max |w|.
///
/// `matrix` is `[dimension × dimension]`, symmetric. The result is exactly symmetric.
///
/// # Errors
/// A wrong length, an element that is not finite, or eigenvalues that do not converge.
pub fn pseudo_inverse(matrix: &[f64], dimension: usize) -> Result<Vec<f64>, LinearError> {
    pseudo_inverse_with_spectrum(matrix, dimension).map(|inverse| inverse.matrix)
}

/// A pseudo-inverse and the eigenvalues of the matrix, ascending.
pub(crate) struct Inverse {
    pub matrix: Vec<f64>,
    pub eigenvalues: Vec<f64>,
    /// How many of them it drops.
    pub truncated: usize,
}

/// As [`pseudo_inverse`].
pub(crate) fn pseudo_inverse_with_spectrum(matrix: &[f64], dimension: usize) -> Result<Inverse, LinearError> {
    check(matrix, dimension)?;
    let Eigen { values, vectors } = eigen(view(matrix, dimension, dimension))?;
    let largest = values.iter().fold(0.0_f64, |largest, value| largest.max(value.abs()));
    let kept = |value: f64| value.abs() > TRUNCATION * largest;
    let scaled = Mat::from_fn(dimension, dimension, |row, column| match values.get(column) {
        Some(&value) if kept(value) => vectors[(row, column)] / value,
        _ => 0.0,
    });
    let matrix = symmetrised(product(scaled.as_ref(), vectors.transpose()).as_ref());
    let truncated = values.iter().filter(|value| !kept(**value)).count();
    Ok(Inverse { matrix, eigenvalues: values, truncated })
}

/// The regularised inverse (C + εI)⁺ of a covariance, ε = 10⁻⁶ (paper, Methods).
///
/// Computes (C + εI)⁻¹ by Cholesky factorisation, at a third of the cost of an eigendecomposition, unless an
/// eigenvalue could be so small that the pseudo-inverse drops it.
///
/// # Errors
/// Those of [`pseudo_inverse`].
pub fn regularised_inverse(covariance: &[f64], dimension: usize) -> Result<Vec<f64>, LinearError> {
    match regularised_factor(covariance, dimension)? {
        Some(factor) => Ok(inverse_of(&factor)),
        None => pseudo_inverse(&regularised(covariance, dimension), dimension),
    }
}

/// L of C + εI = LLᵀ; `None` if an eigenvalue is not positive or could be so small that the pseudo-inverse drops it.
///
/// # Errors
/// A wrong length, an element that is not finite.
pub(crate) fn regularised_factor(
    covariance: &[f64],
    dimension: usize,
) -> Result<Option<Mat<f64>>, LinearError> {
    check(covariance, dimension)?;
    let matrix = regularised(covariance, dimension);
    Ok(if is_positive(trace(&matrix, dimension)) { cholesky(&matrix, dimension) } else { None })
}

/// Whether no eigenvalue of a regularised covariance with this trace can be so small that the pseudo-inverse
/// drops it.
pub(crate) fn is_positive(trace: f64) -> bool {
    TRUNCATION * trace < REGULARISATION
}

pub(crate) fn trace(matrix: &[f64], dimension: usize) -> f64 {
    matrix.iter().step_by(dimension + 1).sum()
}

fn check(matrix: &[f64], dimension: usize) -> Result<(), LinearError> {
    if dimension.checked_mul(dimension) != Some(matrix.len()) {
        return Err(LinearError::Size { dimension, found: matrix.len() });
    }
    match matrix.iter().position(|value| !value.is_finite()) {
        Some(index) => Err(LinearError::NotFinite { row: index / dimension, column: index % dimension }),
        None => Ok(()),
    }
}

/// A⁻¹ = L⁻ᵀL⁻¹ for A = LLᵀ, exactly symmetric.
fn inverse_of(factor: &Mat<f64>) -> Vec<f64> {
    let dimension = factor.nrows();
    let mut out = Mat::zeros(dimension, dimension);
    let scratch = inverse_scratch::<f64>(dimension, Par::Seq);
    inverse(out.as_mut(), factor.as_ref(), Par::Seq, MemStack::new(&mut MemBuffer::new(scratch)));
    // Only the lower triangle was computed.
    let mut full = Vec::with_capacity(dimension * dimension);
    for row in 0..dimension {
        full.extend((0..dimension).map(|column| out[(row.max(column), row.min(column))]));
    }
    full
}

/// C + εI.
pub(crate) fn regularised(covariance: &[f64], dimension: usize) -> Vec<f64> {
    let mut out = covariance.to_vec();
    out.iter_mut().step_by(dimension + 1).for_each(|value| *value += REGULARISATION);
    out
}

/// Number of vectors to pass to [`symmetric_products`] at once: as many as fit the L1 cache beside a panel.
pub(crate) const VECTORS_PER_PASS: usize = 16;

/// Columns of a panel: two of the widest common vector registers.
const PANEL_COLUMNS: usize = 8;

/// S v for each of several vectors and a symmetric row-major S; `vectors` and `out` are `[vectors × D]`.
///
/// The matrix does not fit the L1 cache, but a panel of a few columns does: all vectors pass through a panel
/// before the next is read, two at a time, with their sums in registers. Rows are summed four at a time in a
/// fixed order. Each sum adds the same terms in the same order, independent of the other vectors and of the
/// vector width, and without fused multiply-add. The bits therefore depend neither on the other vectors nor on
/// the processor, and the widest available vectors are used.
pub(crate) fn symmetric_products(matrix: &[f64], dimension: usize, vectors: &[f64], out: &mut [f64]) {
    pulp::Arch::new().dispatch(SymmetricProducts { matrix, dimension, vectors, out });
}

struct SymmetricProducts<'a> {
    matrix: &'a [f64],
    dimension: usize,
    vectors: &'a [f64],
    out: &'a mut [f64],
}

impl pulp::WithSimd for SymmetricProducts<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(mut self, _: S) {
        match self.dimension.checked_sub(PANEL_COLUMNS) {
            // The last panel overlaps the one before and computes the same sums again.
            Some(last) => (0..self.dimension)
                .step_by(PANEL_COLUMNS)
                .for_each(|first| self.panel::<PANEL_COLUMNS>(first.min(last))),
            None => (0..self.dimension).for_each(|column| self.panel::<1>(column)),
        }
    }
}

impl SymmetricProducts<'_> {
    /// The products of `W` columns with every vector.
    #[inline(always)]
    fn panel<const W: usize>(&mut self, first: usize) {
        let &mut Self { matrix, dimension, vectors, ref mut out } = self;
        let (mut pairs, mut sums) =
            (vectors.chunks_exact(2 * dimension), out.chunks_exact_mut(2 * dimension));
        for (pair, out) in pairs.by_ref().zip(sums.by_ref()) {
            let [left, right] = panel_products::<W, 2>(matrix, first, pair.split_at(dimension).into());
            out[first..][..W].copy_from_slice(&left);
            out[dimension + first..][..W].copy_from_slice(&right);
        }
        let last = pairs.remainder();
        if !last.is_empty() {
            let [sums_of_last] = panel_products::<W, 1>(matrix, first, [last]);
            sums.into_remainder()[first..][..W].copy_from_slice(&sums_of_last);
        }
    }
}

/// `W` elements of S v_n from `first` on, for each n.
#[inline(always)]
fn panel_products<const W: usize, const N: usize>(
    matrix: &[f64],
    first: usize,
    vectors: [&[f64]; N],
) -> [[f64; W]; N] {
    let dimension = vectors[0].len();
    let mut sums = [[0.0; W]; N];
    let mut blocks = matrix.chunks_exact(4 * dimension);
    for (block, rows) in blocks.by_ref().enumerate() {
        // Slices of one known length let the compiler vectorise the loops.
        let rows: [&[f64]; 4] = std::array::from_fn(|k| &rows[k * dimension + first..][..W]);
        for (sums, vector) in sums.iter_mut().zip(vectors) {
            let factors = &vector[4 * block..][..4];
            for column in 0..W {
                let [a, b, c, d] = rows.map(|row| row[column]);
                sums[column] += (a * factors[0] + b * factors[1]) + (c * factors[2] + d * factors[3]);
            }
        }
    }
    let whole = dimension - dimension % 4;
    for (row, values) in blocks.remainder().chunks_exact(dimension).enumerate() {
        for (sums, vector) in sums.iter_mut().zip(vectors) {
            let factor = vector[whole + row];
            sums.iter_mut().zip(&values[first..]).for_each(|(sum, value)| *sum += value * factor);
        }
    }
    sums
}

/// Σ a_i b_i of each row of two `[rows × D]` matrices, with the bits of [`dot`] and the widest available vectors.
pub(crate) fn row_dots(left: &[f64], right: &[f64], dimension: usize, out: &mut Vec<f64>) {
    out.resize(left.len() / dimension, 0.0);
    pulp::Arch::new().dispatch(RowDots { left, right, dimension, out });
}

struct RowDots<'a> {
    left: &'a [f64],
    right: &'a [f64],
    dimension: usize,
    out: &'a mut [f64],
}

impl pulp::WithSimd for RowDots<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Self { left, right, dimension, out } = self;
        for (row, out) in out.iter_mut().enumerate() {
            *out = dot(&left[row * dimension..][..dimension], &right[row * dimension..][..dimension]);
        }
    }
}

/// Σ a_i b_i in order, in four interleaved sums (fixed bits, vectorisable).
#[inline(always)]
pub(crate) fn dot(left: &[f64], right: &[f64]) -> f64 {
    let (mut sums, mut rest) = ([0.0; 4], 0.0);
    let (left, right) = (left.chunks_exact(4), right.chunks_exact(4));
    for (a, b) in left.remainder().iter().zip(right.remainder()) {
        rest += a * b;
    }
    for (a, b) in left.zip(right) {
        for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
            *sum += a * b;
        }
    }
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + rest
}

/// |a − b|² in four interleaved sums (fixed bits, vectorisable).
pub(crate) fn squared_distance(left: &[f64], right: &[f64]) -> f64 {
    let (mut sums, mut rest) = ([0.0; 4], 0.0);
    let (left, right) = (left.chunks_exact(4), right.chunks_exact(4));
    for (a, b) in left.remainder().iter().zip(right.remainder()) {
        rest += (a - b) * (a - b);
    }
    for (a, b) in left.zip(right) {
        for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
            *sum += (a - b) * (a - b);
        }
    }
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reference implementation of S v.
    fn plain_product(matrix: &[f64], vector: &[f64]) -> Vec<f64> {
        let dimension = vector.len();
        let term = |row: usize, column: usize| matrix[row * dimension + column] * vector[row];
        let whole = dimension - dimension % 4;
        let sum = |column| {
            let four = |row| {
                (term(row, column) + term(row + 1, column)) + (term(row + 2, column) + term(row + 3, column))
            };
            let sum = (0..whole).step_by(4).fold(0.0, |sum, row| sum + four(row));
            (whole..dimension).fold(sum, |sum, row| sum + term(row, column))
        };
        (0..dimension).map(sum).collect()
    }

    #[test]
    fn a_product_keeps_its_bits_in_any_company() {
        // Numbers of many magnitudes reveal another order of additions or a fused multiply-add.
        let number = |k: usize| ((k * k + 7 * k) as f64).sin() * 10_f64.powi((k * 31 % 9) as i32 - 4);
        let bits = |numbers: &[f64]| numbers.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        for dimension in (1..40).chain([63, 64, 65, 130, 131]) {
            let matrix: Vec<f64> = (0..dimension * dimension).map(number).collect();
            let matrix = symmetrised(view(&matrix, dimension, dimension));
            for count in (0..7).chain([17]) {
                let vectors: Vec<f64> = (0..count * dimension).map(|k| number(3 * k + 11)).collect();
                let mut together = vec![f64::NAN; vectors.len()];
                symmetric_products(&matrix, dimension, &vectors, &mut together);
                for (vector, together) in
                    vectors.chunks_exact(dimension).zip(together.chunks_exact(dimension))
                {
                    let mut alone = vec![f64::NAN; dimension];
                    symmetric_products(&matrix, dimension, vector, &mut alone);
                    assert_eq!(bits(together), bits(&alone), "{dimension} {count}");
                    assert_eq!(bits(&alone), bits(&plain_product(&matrix, vector)), "{dimension} {count}");
                }
            }
        }
    }
}
