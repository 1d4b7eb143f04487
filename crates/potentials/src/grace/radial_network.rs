//! The network on a Chebyshev basis that gives the radial functions, with two derivatives, in double precision.

use super::activation::Activation;
use super::instructions::Instructions;
use super::matrix::{Matrix, StridedRows};
use super::vector::{Double, Vector, lanes_for};
use super::weight_map::WeightMap;

/// x ↦ silu(W_k … silu(W_1 g + b_1) + b_k), where g_k(r) = T_k(x) f_p(u), u = r/r_c, x = 2u − 1, k = 1 …, and
///
/// f_p(u) = 1 − (p+1)(p+2)/2 u^p + p(p+2) u^(p+1) − p(p+1)/2 u^(p+2).
///
/// In models of three layers f_p multiplies the result, not the polynomials.
#[derive(Clone, Debug)]
pub(super) struct RadialNetwork {
    /// Number of Chebyshev polynomials.
    pub basis_size: usize,
    /// p
    pub envelope_exponent: i32,
    /// Whether f_p multiplies the result.
    pub envelope_last: bool,
    /// The last one gives \[l\]\[channel\], its channels padded as those of the layer.
    pub layers: Vec<Matrix<Double>>,
    /// Where the numbers of each layer stand in the file.
    pub maps: Vec<WeightMap>,
    /// b of each layer after the first; empty if absent.
    pub biases: Vec<Vec<Double>>,
    /// b of the first layer for centre and neighbour element, `[n_elements²]`; empty if absent.
    pub pair_biases: Vec<Vec<Double>>,
}

/// A value and its first and second derivative with respect to r, each a row of lanes.
pub(super) type Jet = [Vec<Double>; 3];

impl RadialNetwork {
    /// Lanes of one row of results.
    pub fn output_lanes(&self) -> usize {
        self.layers.last().map_or(0, Matrix::output_lanes)
    }

    /// R_nl and its first two derivatives at distance `r` for the cutoff r_c, Å. Beyond the cutoff, where there
    /// are no bonds, the polynomials continue.
    pub fn evaluate<'a>(&self, r: f64, cutoff: f64, pair: usize, work: &'a mut RadialWork) -> &'a Jet {
        let instructions = Instructions::best();
        self.basis(r, cutoff, &mut work.input);
        for (k, layer) in self.layers.iter().enumerate() {
            for (input, output) in work.input.iter().zip(&mut work.output) {
                output.clear();
                output.resize(layer.output_lanes(), Double::ZERO);
                let row = StridedRows::of_atoms(1, 0);
                layer.multiply_add((&input[..], &mut output[..]), row, row, instructions);
            }
            let bias = if k == 0 { self.pair_biases.get(pair) } else { self.biases.get(k) };
            for (y, b) in work.output[0].iter_mut().zip(bias.into_iter().flatten()) {
                y.add(b);
            }
            if k + 1 < self.layers.len() {
                silu(&mut work.output);
            }
            std::mem::swap(&mut work.input, &mut work.output);
        }
        if self.envelope_last {
            self.multiply_by_envelope(r, cutoff, &mut work.input);
        }
        &work.input
    }

    fn multiply_by_envelope(&self, r: f64, cutoff: f64, [values, first, second]: &mut Jet) {
        let [f, df, ddf] = self.envelope(r / cutoff);
        let (df, ddf) = (df / cutoff, ddf / (cutoff * cutoff));
        let rows =
            Double::flat_mut(values).iter_mut().zip(Double::flat_mut(first)).zip(Double::flat_mut(second));
        for ((y, dy), ddy) in rows {
            *ddy = f * *ddy + 2.0 * df * *dy + ddf * *y;
            *dy = f * *dy + df * *y;
            *y *= f;
        }
    }

    /// g_k(r) with derivatives.
    pub fn basis(&self, r: f64, cutoff: f64, out: &mut Jet) {
        for row in out.iter_mut() {
            row.clear();
            row.resize(lanes_for::<Double>(self.basis_size), Double::ZERO);
        }
        let u = r / cutoff;
        let x = 2.0 * u - 1.0;
        let [f, df, ddf] = if self.envelope_last { [1.0, 0.0, 0.0] } else { self.envelope(u) };
        let mut before = [1.0, 0.0, 0.0]; // T_0, T_0′, T_0″
        let mut t = [x, 1.0, 0.0];
        let [values, first, second] = out.each_mut().map(|row| Double::flat_mut(row));
        for k in 0..self.basis_size {
            values[k] = t[0] * f;
            first[k] = (2.0 * t[1] * f + t[0] * df) / cutoff;
            second[k] = (4.0 * t[2] * f + 4.0 * t[1] * df + t[0] * ddf) / (cutoff * cutoff);
            let next = [
                2.0 * x * t[0] - before[0],
                2.0 * t[0] + 2.0 * x * t[1] - before[1],
                4.0 * t[1] + 2.0 * x * t[2] - before[2],
            ];
            (before, t) = (t, next);
        }
    }

    /// f_p and its derivatives with respect to u, in forms that keep their relative accuracy at the cutoff:
    /// f_p = (1−u)³ Σ_k (k+1)(k+2)/2 u^k, k = 0 … p−1, and f_p′ = −p(p+1)(p+2)/2 u^(p−1) (1−u)².
    fn envelope(&self, u: f64) -> [f64; 3] {
        let (p, v) = (f64::from(self.envelope_exponent), 1.0 - u);
        let coefficient = |k: i32| f64::from((k + 1) * (k + 2)) / 2.0;
        let sum = (0..self.envelope_exponent).rev().fold(0.0, |sum, k| sum * u + coefficient(k));
        let slope = p * (p + 1.0) * (p + 2.0) / 2.0 * u.powi(self.envelope_exponent - 2);
        [v * v * v * sum, -slope * u * v * v, -slope * v * ((p - 1.0) * v - 2.0 * u)]
    }
}

/// [`Activation::Silu`] on a jet.
fn silu([values, first, second]: &mut Jet) {
    let rows = Double::flat_mut(values).iter_mut().zip(Double::flat_mut(first)).zip(Double::flat_mut(second));
    for ((y, dy), ddy) in rows {
        let ((value, slope), curvature) = (Activation::Silu.evaluate(*y), Activation::Silu.curvature(*y));
        *ddy = curvature * *dy * *dy + slope * *ddy;
        *dy *= slope;
        *y = value;
    }
}

/// Scratch arrays of [`RadialNetwork::evaluate`].
#[derive(Clone, Debug, Default)]
pub(super) struct RadialWork {
    input: Jet,
    output: Jet,
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub fn network(envelope_last: bool) -> RadialNetwork {
        let element = |i: usize, o: usize| ((5 * i + 3 * o) % 13) as f64 / 13.0 - 0.45;
        RadialNetwork {
            basis_size: 5,
            envelope_exponent: 16,
            envelope_last,
            biases: if envelope_last { vec![vec![], vec![Double::splat(0.3)]] } else { vec![] },
            pair_biases: if envelope_last { vec![vec![Double::splat(-0.2); 2]] } else { vec![] },
            maps: Vec::new(),
            layers: vec![
                Matrix::from_fn(5, 12, element),
                Matrix::from_fn(12, 12, element),
                Matrix::from_fn(12, 9, element),
            ],
        }
    }

    #[test]
    fn derivatives_of_the_network_are_differences() {
        for envelope_last in [false, true] {
            check_derivatives(&network(envelope_last));
        }
    }

    fn check_derivatives(network: &RadialNetwork) {
        let (cutoff, h) = (5.0, 1e-4);
        let jet = |r: f64| network.evaluate(r, cutoff, 0, &mut RadialWork::default()).clone();
        for r in [0.4, 2.3, 3.9, 4.99] {
            let (centre, plus, minus) = (jet(r), jet(r + h), jet(r - h));
            for order in 0..2 {
                for k in 0..9 {
                    let at = |jet: &Jet| Double::flat(&jet[order])[k];
                    let difference = (at(&plus) - at(&minus)) / (2.0 * h);
                    let derivative = Double::flat(&centre[order + 1])[k];
                    assert!(
                        (difference - derivative).abs() < 1e-5 * (1.0 + derivative.abs()),
                        "{r} {order} {k}"
                    );
                }
            }
        }
        assert!(jet(5.0).iter().all(|order| Double::flat(order).iter().all(|x| *x == 0.0)));
    }
}
