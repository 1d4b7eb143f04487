//! The triclinic cell and the 3×3 operations it needs.

use serde::{Deserialize, Serialize};

/// A vector in space, Å unless said otherwise.
pub type Vec3 = [f64; 3];

/// A 3×3 matrix by rows.
pub type Matrix3 = [[f64; 3]; 3];

/// Lattice vectors as rows, Å. A direction that is not periodic may have any non-degenerate vector.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Cell(pub Matrix3);

impl Cell {
    /// An orthorhombic cell with edges `a`, `b`, `c`, Å.
    pub fn orthorhombic(a: f64, b: f64, c: f64) -> Self {
        Self([[a, 0.0, 0.0], [0.0, b, 0.0], [0.0, 0.0, c]])
    }

    /// Volume, Å³; negative for a left-handed set of lattice vectors.
    pub fn signed_volume(&self) -> f64 {
        let [a, b, c] = self.0;
        dot(a, cross(b, c))
    }

    /// |Volume|, Å³.
    pub fn volume(&self) -> f64 {
        self.signed_volume().abs()
    }

    /// Rows of the inverse transposed: the reciprocal vectors b_i with a_i · b_j = δ_ij, 1/Å.
    pub fn reciprocal(&self) -> Matrix3 {
        let [a, b, c] = self.0;
        let volume = self.signed_volume();
        [scale(cross(b, c), 1.0 / volume), scale(cross(c, a), 1.0 / volume), scale(cross(a, b), 1.0 / volume)]
    }

    /// Lengths a, b, c of the lattice vectors, Å, and the angles α = ∠(b, c), β = ∠(a, c) and γ = ∠(a, b) between them, °.
    pub fn lengths_and_angles(&self) -> [f64; 6] {
        let [a, b, c] = self.0;
        let angle = |u, v| (dot(u, v) / (norm(u) * norm(v))).clamp(-1.0, 1.0).acos().to_degrees();
        [norm(a), norm(b), norm(c), angle(b, c), angle(a, c), angle(a, b)]
    }

    /// Distance between opposite faces of the cell in each lattice direction, Å.
    pub fn heights(&self) -> Vec3 {
        self.reciprocal().map(|b| 1.0 / norm(b))
    }

    /// Fractional coordinates of a Cartesian position.
    pub fn fractional(&self, position: Vec3) -> Vec3 {
        self.reciprocal().map(|b| dot(b, position))
    }

    /// Cartesian position of fractional coordinates, Å.
    pub fn cartesian(&self, fractional: Vec3) -> Vec3 {
        let [a, b, c] = self.0;
        std::array::from_fn(|k| fractional[0] * a[k] + fractional[1] * b[k] + fractional[2] * c[k])
    }

    /// The cell with non-periodic lattice vectors replaced by unit vectors orthogonal to all others.
    ///
    /// Ignores the given vectors of those directions, which are often zero.
    pub fn completed(&self, periodic: [bool; 3]) -> Self {
        let mut rows = self.0;
        match periodic {
            [true, true, true] => {}
            [false, false, false] => rows = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            _ => {
                // In cyclic order, the first periodic vector is at k and a gap precedes or follows it.
                let k = (0..3).find(|k| periodic[*k] && !periodic[(k + 2) % 3]).unwrap_or(0);
                let (second, third) = ((k + 1) % 3, (k + 2) % 3);
                if !periodic[second] {
                    let axis = (0..3).fold(0, |m, n| if rows[k][n].abs() < rows[k][m].abs() { n } else { m });
                    let mut least_aligned = [0.0; 3];
                    least_aligned[axis] = 1.0;
                    rows[second] = unit(cross(rows[k], least_aligned));
                }
                rows[third] = unit(cross(rows[k], rows[second]));
            }
        }
        Self(rows)
    }

    /// The translation of a periodic image, Å.
    #[inline]
    pub fn translation(&self, image: [i32; 3]) -> Vec3 {
        self.cartesian(image.map(f64::from))
    }
}

/// a · b
#[inline]
pub fn dot(a: Vec3, b: Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// a × b
#[inline]
pub fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// |a|
#[inline]
pub fn norm(a: Vec3) -> f64 {
    dot(a, a).sqrt()
}

/// a / |a|
#[inline]
pub fn unit(a: Vec3) -> Vec3 {
    scale(a, 1.0 / norm(a))
}

/// s a
#[inline]
pub fn scale(a: Vec3, s: f64) -> Vec3 {
    a.map(|x| s * x)
}

/// a + b
#[inline]
pub fn add(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// a − b
#[inline]
pub fn sub(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// x M for a row vector x: Σ_i x_i M_ik.
#[inline]
pub fn row_times(x: Vec3, m: &Matrix3) -> Vec3 {
    std::array::from_fn(|k| x[0] * m[0][k] + x[1] * m[1][k] + x[2] * m[2][k])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fractional_and_cartesian_are_inverse() {
        let cell = Cell([[4.0, 0.3, 0.0], [-1.0, 5.0, 0.2], [0.5, 0.1, 6.0]]);
        let position = [1.5, -7.0, 22.0];
        let back = cell.cartesian(cell.fractional(position));
        assert!(norm(sub(back, position)) < 1e-12);
        let [lengths, angles] = [[5.0, 2.0, 3.0], [90.0, 60.0, 90.0]];
        let (c, s) = (3.0 * 0.5, 3.0 * 0.75_f64.sqrt());
        let oblique = Cell([[5.0, 0.0, 0.0], [0.0, 2.0, 0.0], [c, 0.0, s]]).lengths_and_angles();
        for (found, expected) in oblique.iter().zip(lengths.iter().chain(&angles)) {
            assert!((found - expected).abs() < 1e-12, "{oblique:?}");
        }
        assert!((cell.heights()[2] - cell.volume() / norm(cross(cell.0[0], cell.0[1]))).abs() < 1e-12);
    }
}
