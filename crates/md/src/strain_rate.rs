//! Exact solutions of the linear equations that a strain rate makes.

use atoms::cell::{self, dot};
use atoms::{Matrix3, Vec3};

/// The identity.
pub(crate) const IDENTITY: Matrix3 = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

/// Sweeps after which the rotations of a 3×3 matrix have long converged; they need about five.
const MAX_SWEEPS: usize = 30;

/// A strain rate ν = Σ_k λ_k l_kᵀ r_k with row vectors l_k and r_k, l_j · r_k = δ_jk: for a symmetric one the l_k and
/// r_k are its eigenvectors, for one that keeps the directions of lattice vectors r_k are these and l_k the
/// reciprocal ones.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StrainModes {
    /// λ, 1/fs.
    pub rates: Vec3,
    left: Matrix3,
    right: Matrix3,
}

impl StrainModes {
    /// The modes of a symmetric strain rate.
    pub fn of_symmetric(rate: &Matrix3) -> Self {
        let (rates, vectors) = eigen(rate);
        Self { rates, left: vectors, right: vectors }
    }

    /// The modes of a strain rate that keeps the directions of `lattice` (rows) with their `reciprocal` vectors.
    pub fn along(lattice: &Matrix3, reciprocal: &Matrix3, rate: &Matrix3) -> Self {
        let along = |k: usize| dot(cell::row_times(lattice[k], rate), reciprocal[k]);
        Self { rates: std::array::from_fn(along), left: *reciprocal, right: *lattice }
    }

    /// f(ν) = Σ_k f(λ_k) l_kᵀ r_k.
    pub fn function(&self, f: impl Fn(f64) -> f64) -> Matrix3 {
        let values = self.rates.map(f);
        let entry = |i: usize, j: usize| (0..3).map(|k| self.left[k][i] * values[k] * self.right[k][j]).sum();
        std::array::from_fn(|i| std::array::from_fn(|j| entry(i, j)))
    }
}

/// (e^x − 1) / x = e^(x/2) sinh(x/2) / (x/2). `exp_m1` is exact to rounding near 0, so it needs no series there.
pub(crate) fn phi(x: f64) -> f64 {
    if x == 0.0 { 1.0 } else { x.exp_m1() / x }
}

pub(crate) fn transposed(m: &Matrix3) -> Matrix3 {
    std::array::from_fn(|i| std::array::from_fn(|j| m[j][i]))
}

/// A B.
pub(crate) fn product(a: &Matrix3, b: &Matrix3) -> Matrix3 {
    a.map(|row| cell::row_times(row, b))
}

/// Σ_ij A_ij B_ij.
pub(crate) fn contraction(a: &Matrix3, b: &Matrix3) -> f64 {
    a.iter().zip(b).map(|(a, b)| dot(*a, *b)).sum()
}

pub(crate) fn trace(m: &Matrix3) -> f64 {
    m[0][0] + m[1][1] + m[2][2]
}

/// Entry by entry, f(A_ij, B_ij).
pub(crate) fn combined(a: &Matrix3, b: &Matrix3, f: impl Fn(f64, f64) -> f64) -> Matrix3 {
    std::array::from_fn(|i| std::array::from_fn(|j| f(a[i][j], b[i][j])))
}

/// Eigenvalues and eigenvectors (rows) of a symmetric matrix, by cyclic Jacobi rotations (Golub & Van Loan, Matrix
/// Computations, section 8.5).
fn eigen(matrix: &Matrix3) -> (Vec3, Matrix3) {
    let (mut a, mut vectors) = (*matrix, IDENTITY);
    for _ in 0..MAX_SWEEPS {
        if a[0][1] == 0.0 && a[0][2] == 0.0 && a[1][2] == 0.0 {
            break;
        }
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            rotate(&mut a, &mut vectors, p, q);
        }
    }
    ([a[0][0], a[1][1], a[2][2]], vectors)
}

/// Makes a_pq zero by a rotation in the plane of axes p and q.
fn rotate(a: &mut Matrix3, vectors: &mut Matrix3, p: usize, q: usize) {
    let off = a[p][q];
    // Too small to change the diagonal.
    if off.abs() <= 0.125 * f64::EPSILON * (a[p][p].abs().min(a[q][q].abs())) {
        (a[p][q], a[q][p]) = (0.0, 0.0);
        return;
    }
    let half_cotangent = (a[q][q] - a[p][p]) / (2.0 * off);
    let t = half_cotangent.signum() / (half_cotangent.abs() + half_cotangent.hypot(1.0));
    let c = 1.0 / t.hypot(1.0);
    let s = t * c;
    let r = 3 - p - q;
    (a[p][p], a[q][q]) = (a[p][p] - t * off, a[q][q] + t * off);
    (a[p][q], a[q][p]) = (0.0, 0.0);
    let (rp, rq) = (a[r][p], a[r][q]);
    (a[r][p], a[r][q]) = (c * rp - s * rq, s * rp + c * rq);
    (a[p][r], a[q][r]) = (a[r][p], a[r][q]);
    let (x, y) = (vectors[p], vectors[q]);
    vectors[p] = cell::sub(cell::scale(x, c), cell::scale(y, s));
    vectors[q] = cell::add(cell::scale(x, s), cell::scale(y, c));
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// e^M by scaling, a Taylor series and squaring.
    fn exponential(m: &Matrix3) -> Matrix3 {
        let small = m.map(|row| row.map(|x| x / 16.0));
        let (mut sum, mut term) = (IDENTITY, IDENTITY);
        for n in 1..16 {
            term = product(&term, &small).map(|row| row.map(|x| x / f64::from(n)));
            sum = combined(&sum, &term, |a, b| a + b);
        }
        (0..4).fold(sum, |power, _| product(&power, &power))
    }

    fn distance(a: &Matrix3, b: &Matrix3) -> f64 {
        combined(a, b, |a, b| (a - b).abs()).iter().flatten().copied().fold(0.0, f64::max)
    }

    fn symmetric([xx, yy, zz, yz, xz, xy]: [f64; 6]) -> Matrix3 {
        [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
    }

    proptest! {
        #[test]
        fn functions_of_symmetric_rates_are_exact(entries in prop::array::uniform6(-1.0..1.0), power in -8..1) {
            let rate = symmetric(entries.map(|x: f64| x * 10_f64.powi(power)));
            let modes = StrainModes::of_symmetric(&rate);
            prop_assert!(distance(&modes.function(|x| x), &rate) < 2e-15 * 10_f64.powi(power));
            prop_assert!(distance(&modes.function(f64::exp), &exponential(&rate)) < 2e-13);
            // e^ν = 1 + ν φ(ν)
            let by_phi = combined(&IDENTITY, &product(&rate, &modes.function(phi)), |a, b| a + b);
            prop_assert!(distance(&modes.function(f64::exp), &by_phi) < 1e-14);
        }
    }

    #[test]
    fn degenerate_and_diagonal_rates_are_exact() {
        for entries in [
            [0.0; 6],
            [0.3, 0.3, 0.3, 0.0, 0.0, 0.0],
            [1.0, 2.0, 1.0, 0.0, 0.5, 0.0],
            [0.0, 0.0, 0.0, 1.0, 1.0, 1.0],
        ] {
            let rate = symmetric(entries);
            let modes = StrainModes::of_symmetric(&rate);
            assert!(distance(&modes.function(f64::exp), &exponential(&rate)) < 1e-13);
        }
        let rest = StrainModes::of_symmetric(&[[0.0; 3]; 3]);
        assert_eq!((rest.function(f64::exp), rest.function(phi)), (IDENTITY, IDENTITY));
    }

    #[test]
    fn rates_along_lattice_vectors_keep_their_directions() {
        let lattice = atoms::Cell([[4.0, 0.3, -0.2], [-1.0, 5.0, 0.2], [0.5, 0.1, 6.0]]);
        let reciprocal = lattice.reciprocal();
        let modes = StrainModes { rates: [0.1, -0.2, 0.3], left: reciprocal, right: lattice.0 };
        let rate = modes.function(|x| x);
        let again = StrainModes::along(&lattice.0, &reciprocal, &rate);
        let stretched = product(&lattice.0, &again.function(f64::exp));
        for (k, expected) in [0.1_f64, -0.2, 0.3].into_iter().enumerate() {
            assert!((again.rates[k] - expected).abs() < 1e-15);
            let wanted = cell::scale(lattice.0[k], expected.exp());
            assert!(cell::norm(cell::sub(stretched[k], wanted)) < 1e-14);
        }
        assert!(distance(&again.function(f64::exp), &exponential(&rate)) < 1e-13);
    }

    #[test]
    fn phi_is_smooth_at_zero() {
        assert_eq!(phi(0.0), 1.0);
        for x in [1e-300, 1e-17, 1e-9, 1e-6] {
            assert!((phi(x) - (1.0 + x / 2.0 + x * x / 6.0)).abs() < 1e-15);
            assert!((phi(-x) * f64::exp(x) / phi(x) - 1.0).abs() < 1e-15);
        }
    }
}
