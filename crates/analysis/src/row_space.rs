//! What a matrix maps to zero, and what it does not.

use faer::MatRef;

/// A row is a combination of those before it if less than this share of its length is left of it.
const DEPENDENT: f64 = 1e-12;

/// Singular values of a matrix, `[n × columns]`, descending. `None` for an empty matrix, numbers that are not finite, or values that do
/// not converge.
pub fn singular_values(rows: &[f64], columns: usize) -> Option<Vec<f64>> {
    let count = rows.len().checked_div(columns)?;
    if count == 0 || count * columns != rows.len() || !rows.iter().all(|x| x.is_finite()) {
        return None;
    }
    MatRef::from_row_major_slice(rows, count, columns).singular_values().ok()
}

/// The space that the rows of a matrix J span: J = L Q with a lower triangular L and orthonormal rows of Q (Gram and Schmidt, twice).
#[derive(Clone, Debug)]
pub struct RowSpace {
    /// Q
    basis: Vec<Vec<f64>>,
    /// L; row k has k + 1 numbers.
    factor: Vec<Vec<f64>>,
}

impl RowSpace {
    /// Of a matrix `[n × columns]`. `None` if a row depends on those before it.
    pub fn new(rows: &[f64], columns: usize) -> Option<Self> {
        let mut found = Self { basis: Vec::new(), factor: Vec::new() };
        for row in rows.chunks_exact(columns) {
            let (mut left, mut coefficients) = (row.to_vec(), vec![0.0; found.basis.len()]);
            for _ in 0..2 {
                for (coefficient, axis) in coefficients.iter_mut().zip(&found.basis) {
                    *coefficient += take_out(axis, &mut left);
                }
            }
            let length = length(&left);
            // Also false for a row of zeros, and if a number is not finite.
            let is_new = length > DEPENDENT * self::length(row);
            if !is_new {
                return None;
            }
            left.iter_mut().for_each(|x| *x /= length);
            coefficients.push(length);
            found.basis.push(left);
            found.factor.push(coefficients);
        }
        Some(found)
    }

    /// Makes J v = 0, by the smallest change of v.
    pub fn remove_from(&self, vector: &mut [f64]) {
        for _ in 0..2 {
            for axis in &self.basis {
                take_out(axis, vector);
            }
        }
    }

    /// The shortest x with J x = `right`.
    pub fn solve(&self, right: &[f64]) -> Vec<f64> {
        let mut along: Vec<f64> = Vec::with_capacity(self.factor.len());
        for (factor, right) in self.factor.iter().zip(right) {
            let known: f64 = factor.iter().zip(&along).map(|(l, y)| l * y).sum();
            along.push((right - known) / factor[along.len()]);
        }
        let mut x = vec![0.0; self.basis.first().map_or(0, Vec::len)];
        for (axis, along) in self.basis.iter().zip(&along) {
            x.iter_mut().zip(axis).for_each(|(x, axis)| *x += along * axis);
        }
        x
    }
}

/// Takes the part along a unit vector out. Returns its size.
fn take_out(axis: &[f64], vector: &mut [f64]) -> f64 {
    let along: f64 = axis.iter().zip(&*vector).map(|(a, b)| a * b).sum();
    vector.iter_mut().zip(axis).for_each(|(x, axis)| *x -= along * axis);
    along
}

fn length(vector: &[f64]) -> f64 {
    vector.iter().map(|x| x * x).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const COLUMNS: usize = 7;

    fn product(rows: &[f64], vector: &[f64]) -> Vec<f64> {
        rows.chunks_exact(COLUMNS).map(|row| row.iter().zip(vector).map(|(a, b)| a * b).sum()).collect()
    }

    /// numpy.linalg.svd(…, compute_uv=False) of two small matrices.
    #[test]
    fn singular_values_are_those_of_numpy() {
        let rows = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let close = |found: &[f64], expected: &[f64]| {
            found.len() == expected.len() && found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-13)
        };
        let expected = [9.508_032_000_695_724, 0.772_869_635_673_484_8];
        assert!(close(&singular_values(&rows, 3).unwrap(), &expected));
        assert!(close(&singular_values(&[1.0, 4.0, 2.0, 5.0, 3.0, 6.0], 2).unwrap(), &expected));
        assert_eq!(singular_values(&[], 3), None);
        assert_eq!(singular_values(&rows, 4), None);
        assert_eq!(singular_values(&[1.0, f64::NAN], 2), None);
    }

    #[test]
    fn dependent_rows_span_no_space() {
        let row = [1.0, 2.0, 0.0, -1.0, 0.5, 3.0, 1.0];
        let twice: Vec<_> = row.iter().copied().chain(row.map(|x| -2.0 * x)).collect();
        assert!(RowSpace::new(&twice, COLUMNS).is_none());
        assert!(RowSpace::new(&[0.0; COLUMNS], COLUMNS).is_none());
        let rank = singular_values(&twice, COLUMNS).unwrap();
        assert!(rank[0] > 1.0 && rank[1] < 1e-12 * rank[0], "{rank:?}");
    }

    proptest! {
        /// Of matrices that are far from dependent.
        #[test]
        fn what_is_left_is_mapped_to_zero_and_solutions_are_the_shortest(
            noise in prop::collection::vec(-0.2_f64..0.2, 3 * COLUMNS),
            vector in prop::collection::vec(-1.0_f64..1.0, COLUMNS),
            right in prop::collection::vec(-1.0_f64..1.0, 3),
        ) {
            let mut rows = noise;
            (0..3).for_each(|k| rows[k * COLUMNS + k] += 1.5);
            let space = RowSpace::new(&rows, COLUMNS).unwrap();
            let mut left = vector.clone();
            space.remove_from(&mut left);
            prop_assert!(product(&rows, &left).iter().all(|x| x.abs() < 1e-13));
            let mut rest: Vec<_> = vector.iter().zip(&left).map(|(a, b)| a - b).collect();
            space.remove_from(&mut rest);
            prop_assert!(length(&rest) < 1e-13);
            let mut solution = space.solve(&right);
            let found = product(&rows, &solution);
            prop_assert!(found.iter().zip(&right).all(|(a, b)| (a - b).abs() < 1e-12));
            space.remove_from(&mut solution);
            prop_assert!(length(&solution) < 1e-12);
        }
    }
}
