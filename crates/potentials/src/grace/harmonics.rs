//! Real spherical harmonics as polynomials in Cartesian components, and their gradients.

use super::vector::{Number, Vector};

/// Y_lm for l = 0 … lmax at index l² + l + m, normalised to Y_00 = 1 (√4π times orthonormal):
///
/// Y_l,m = Re\[(x + iy)^m\] Q_lm(z), Y_l,−m = Im\[(x + iy)^m\] Q_lm(z) for m ≥ 0, with the associated Legendre
/// recursion Q_lm = a_lm (z Q_(l−1)m + b_lm Q_(l−2)m). They are evaluated as these polynomials also where (x,
/// y, z) is not exactly of unit length.
#[derive(Clone, Debug)]
pub(super) struct Harmonics {
    lmax: usize,
    /// Q_mm, constants; √2 included for m > 0. `[lmax + 1]`
    diagonal: Vec<f64>,
    /// (a_lm, b_lm) for m = 0 … lmax, l = m + 1 … lmax, in this order.
    recursion: Vec<(f64, f64)>,
}

impl Harmonics {
    pub fn new(lmax: usize) -> Self {
        let mut diagonal = vec![1.0];
        let mut q = std::f64::consts::SQRT_2;
        for m in 1..=lmax {
            q *= (1.0 + 0.5 / m as f64).sqrt();
            diagonal.push(q);
        }
        let mut recursion = Vec::new();
        for m in 0..=lmax {
            for l in m + 1..=lmax {
                let (l2, m2, k2) = ((l * l) as f64, (m * m) as f64, ((l - 1) * (l - 1)) as f64);
                let a = ((4.0 * l2 - 1.0) / (l2 - m2)).sqrt();
                let b = if l == m + 1 { 0.0 } else { -((k2 - m2) / (4.0 * k2 - 1.0)).sqrt() };
                recursion.push((a, b));
            }
        }
        Self { lmax, diagonal, recursion }
    }

    pub fn lmax(&self) -> usize {
        self.lmax
    }

    /// Number of functions, (lmax + 1)².
    pub fn len(&self) -> usize {
        (self.lmax + 1) * (self.lmax + 1)
    }

    /// Writes Y_lm at directions v = (x, y, z), one per lane, to `values`, `[lm]`; with `GRADIENT` also
    /// ∂Y_lm/∂v to `gradients`, `[lm]`.
    #[inline(always)]
    pub fn evaluate<V: Vector, const GRADIENT: bool>(
        &self,
        [x, y, z]: &[V; 3],
        values: &mut [V],
        gradients: &mut [[V; 3]],
    ) {
        let (mut recursion, round) = (self.recursion.iter(), V::Number::round);
        // (x + iy)^m and (x + iy)^(m−1)
        let (mut c, mut s) = (V::splat(round(1.0)), V::ZERO);
        let (mut c_before, mut s_before) = (V::ZERO, V::ZERO);
        for m in 0..=self.lmax {
            let mut q = V::splat(round(self.diagonal[m]));
            let (mut dq, mut q_before, mut dq_before) = (V::ZERO, V::ZERO, V::ZERO);
            for l in m..=self.lmax {
                if l > m {
                    let (a, b) = recursion.next().copied().unwrap_or_default();
                    let (a, b) = (round(a), round(b));
                    for k in 0..V::LANES {
                        let q_next = a * (z[k] * q[k] + b * q_before[k]);
                        let dq_next = a * (q[k] + z[k] * dq[k] + b * dq_before[k]);
                        (q_before[k], q[k]) = (q[k], q_next);
                        (dq_before[k], dq[k]) = (dq[k], dq_next);
                    }
                }
                let (plus, minus) = (l * l + l + m, l * l + l - m);
                values[plus] = c.product(&q);
                if m > 0 {
                    values[minus] = s.product(&q);
                }
                if GRADIENT {
                    let mq = q.scaled(round(m as f64));
                    let along_x = c_before.product(&mq);
                    let along_y = s_before.product(&mq);
                    gradients[plus] = [along_x, along_y.scaled(round(-1.0)), c.product(&dq)];
                    if m > 0 {
                        gradients[minus] = [along_y, along_x, s.product(&dq)];
                    }
                }
            }
            (c_before, s_before) = (c, s);
            for k in 0..V::LANES {
                c[k] = x[k] * c_before[k] - y[k] * s_before[k];
                s[k] = x[k] * s_before[k] + y[k] * c_before[k];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::vector::Double;
    use super::*;

    fn at(harmonics: &Harmonics, v: [f64; 3]) -> (Vec<f64>, Vec<[f64; 3]>) {
        let mut values = vec![Double::ZERO; harmonics.len()];
        let mut gradients = vec![[Double::ZERO; 3]; harmonics.len()];
        harmonics.evaluate::<Double, true>(&v.map(Double::splat), &mut values, &mut gradients);
        (values.iter().map(|y| y[3]).collect(), gradients.iter().map(|g| g.map(|g| g[3])).collect())
    }

    #[test]
    fn low_orders_are_the_textbook_polynomials() {
        let [x, y, z] = [0.36, -0.48, 0.8];
        let (values, _) = at(&Harmonics::new(2), [x, y, z]);
        let s = 15_f64.sqrt();
        let expected = [
            1.0,
            3_f64.sqrt() * y,
            3_f64.sqrt() * z,
            3_f64.sqrt() * x,
            s * x * y,
            s * y * z,
            5_f64.sqrt() / 2.0 * (3.0 * z * z - 1.0),
            s * x * z,
            s / 2.0 * (x * x - y * y),
        ];
        for (k, (value, expected)) in values.iter().zip(expected).enumerate() {
            assert!((value - expected).abs() < 1e-14, "{k}: {value} {expected}");
        }
    }

    /// The addition theorem for equal directions: Σ_m Y_lm² = 2l + 1.
    #[test]
    fn squares_of_one_order_sum_to_its_degeneracy() {
        let (values, _) = at(&Harmonics::new(6), [0.48, 0.6, 0.64]);
        for l in 0..=6 {
            let sum: f64 = values[l * l..(l + 1) * (l + 1)].iter().map(|y| y * y).sum();
            assert!((sum - (2 * l + 1) as f64).abs() < 1e-12, "{l}: {sum}");
        }
    }

    #[test]
    fn gradients_are_differences() {
        let harmonics = Harmonics::new(5);
        let v = [0.3, -0.7, 0.55];
        let (_, gradients) = at(&harmonics, v);
        let h = 1e-5;
        for axis in 0..3 {
            let moved = |shift: f64| {
                let mut v = v;
                v[axis] += shift;
                at(&harmonics, v).0
            };
            let (plus, minus) = (moved(h), moved(-h));
            for lm in 0..harmonics.len() {
                let difference = (plus[lm] - minus[lm]) / (2.0 * h);
                assert!((gradients[lm][axis] - difference).abs() < 1e-8, "{lm} {axis}");
            }
        }
    }
}
