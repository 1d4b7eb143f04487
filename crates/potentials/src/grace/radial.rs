//! Radial functions R_nl(r): a small network on a Chebyshev basis, evaluated exactly or from a table.

use super::matrix::{LANES, Lanes, Matrix, ZERO, lanes_for};
use super::radial_table::{RadialTable, b_splines};

/// How radial functions are evaluated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum RadialPath {
    /// The network itself, for every bond.
    Exact,
    /// Splines of degree seven; the errors of values and of derivatives are at most 10⁻¹¹ of the largest,
    /// measured when a model is read.
    #[default]
    Table,
}

/// x ↦ silu(W_k … silu(W_1 g)), where g_k(r) = T_k(x) f_p(u), u = r/r_c, x = 2u − 1, k = 1 …, and
///
/// f_p(u) = 1 − (p+1)(p+2)/2 u^p + p(p+2) u^(p+1) − p(p+1)/2 u^(p+2).
#[derive(Clone, Debug)]
pub(super) struct RadialNetwork {
    /// Number of Chebyshev polynomials.
    pub basis_size: usize,
    /// p
    pub envelope_exponent: i32,
    /// Layers without the bias they do not have; the last one gives \[l\]\[channel\].
    pub layers: Vec<Matrix>,
}

/// A value and its first and second derivative with respect to r, each a row of lanes.
pub(super) type Jet = [Vec<Lanes>; 3];

impl RadialNetwork {
    /// Lanes of one row of results.
    pub fn output_lanes(&self) -> usize {
        self.layers.last().map_or(0, Matrix::output_lanes)
    }

    /// R_nl and its first two derivatives at distance `r` for the cutoff r_c, Å; the polynomials simply go
    /// on beyond the cutoff, where no bond is.
    pub fn evaluate<'a>(&self, r: f64, cutoff: f64, work: &'a mut RadialWork) -> &'a Jet {
        self.basis(r, cutoff, &mut work.input);
        for (k, layer) in self.layers.iter().enumerate() {
            for (input, output) in work.input.iter().zip(&mut work.output) {
                output.clear();
                output.resize(layer.output_lanes(), ZERO);
                layer.multiply_add_row(input, output);
            }
            if k + 1 < self.layers.len() {
                silu(&mut work.output);
            }
            std::mem::swap(&mut work.input, &mut work.output);
        }
        &work.input
    }

    /// g_k(r) with derivatives.
    fn basis(&self, r: f64, cutoff: f64, out: &mut Jet) {
        for row in out.iter_mut() {
            row.clear();
            row.resize(lanes_for(self.basis_size), ZERO);
        }
        let u = r / cutoff;
        let x = 2.0 * u - 1.0;
        let [f, df, ddf] = self.envelope(u);
        let mut before = [1.0, 0.0, 0.0]; // T_0, T_0′, T_0″
        let mut t = [x, 1.0, 0.0];
        let [values, first, second] = out.each_mut().map(|row| row.as_flattened_mut());
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

/// silu(x) = x / (1 + e^−x) on a jet.
fn silu([values, first, second]: &mut Jet) {
    let rows =
        values.as_flattened_mut().iter_mut().zip(first.as_flattened_mut()).zip(second.as_flattened_mut());
    for ((y, dy), ddy) in rows {
        let x = *y;
        let s = 1.0 / (1.0 + (-x).exp());
        let slope = s * (1.0 + x * (1.0 - s));
        let curvature = s * (1.0 - s) * (2.0 + x * (1.0 - 2.0 * s));
        *ddy = curvature * *dy * *dy + slope * *ddy;
        *dy *= slope;
        *y = x * s;
    }
}

/// Work arrays of [`RadialNetwork::evaluate`].
#[derive(Clone, Debug, Default)]
pub(super) struct RadialWork {
    input: Jet,
    output: Jet,
}

/// The radial functions of every pair of elements.
#[derive(Clone, Debug)]
pub(super) struct RadialFunctions {
    network: RadialNetwork,
    n_elements: usize,
    /// r_c for centre and neighbour element, [n_elements²], Å.
    cutoffs: Vec<f64>,
    /// One table for each distinct cutoff; none for the exact path.
    tables: Vec<RadialTable>,
    /// Which table belongs to centre and neighbour element, [n_elements²].
    table_of_pair: Vec<usize>,
}

impl RadialFunctions {
    pub fn new(network: RadialNetwork, n_elements: usize, cutoffs: Vec<f64>, path: RadialPath) -> Self {
        let mut tables: Vec<RadialTable> = Vec::new();
        let mut table_of_pair = Vec::new();
        if path == RadialPath::Table {
            for cutoff in &cutoffs {
                let known = tables.iter().position(|table| table.cutoff() == *cutoff);
                table_of_pair.push(known.unwrap_or(tables.len()));
                if known.is_none() {
                    tables.push(RadialTable::new(&network, *cutoff));
                }
            }
        }
        Self { network, n_elements, cutoffs, tables, table_of_pair }
    }

    /// Index of a pair of elements.
    #[inline(always)]
    pub fn pair(&self, centre: usize, neighbour: usize) -> usize {
        centre * self.n_elements + neighbour
    }

    /// r_c of a pair, Å.
    #[inline(always)]
    pub fn cutoff(&self, pair: usize) -> f64 {
        self.cutoffs[pair]
    }

    /// The largest r_c, Å.
    pub fn largest_cutoff(&self) -> f64 {
        self.cutoffs.iter().copied().fold(0.0, f64::max)
    }

    /// Lanes of R_nl of one bond, \[l\]\[channel\].
    pub fn output_lanes(&self) -> usize {
        self.network.output_lanes()
    }

    /// The tables, for a description of the model.
    pub fn tables(&self) -> &[RadialTable] {
        &self.tables
    }

    /// R_nl and dR_nl/dr of `n` ≤ 8 bonds at distances `r` between pairs of elements, each
    /// \[bond\]\[l\]\[channel\]; r within the cutoff of the pair.
    #[inline(always)]
    pub fn evaluate(
        &self,
        n: usize,
        pairs: &[usize; LANES],
        r: &Lanes,
        work: &mut RadialWork,
        values: &mut [Lanes],
        derivatives: &mut [Lanes],
    ) {
        if self.tables.is_empty() {
            return self.evaluate_exactly(n, pairs, r, work, values, derivatives);
        }
        let (lanes, mut places) = (self.output_lanes(), ZERO);
        let mut located = [(&self.tables[0], 0); LANES];
        for b in 0..n {
            let table = &self.tables[self.table_of_pair[pairs[b]]];
            let (interval, t) = table.locate(r[b]);
            places[b] = t;
            located[b] = (table, interval);
        }
        let weights = b_splines(&places);
        let rows = values.chunks_exact_mut(lanes).zip(derivatives.chunks_exact_mut(lanes));
        for (b, (values, derivatives)) in rows.enumerate().take(n) {
            let (table, interval) = located[b];
            table.combine(interval, b, &weights, values, derivatives);
        }
    }

    fn evaluate_exactly(
        &self,
        n: usize,
        pairs: &[usize; LANES],
        r: &Lanes,
        work: &mut RadialWork,
        values: &mut [Lanes],
        derivatives: &mut [Lanes],
    ) {
        let lanes = self.output_lanes();
        let rows = values.chunks_exact_mut(lanes).zip(derivatives.chunks_exact_mut(lanes));
        for (b, (values, derivatives)) in rows.enumerate().take(n) {
            let [value, derivative, _] = self.network.evaluate(r[b], self.cutoffs[pairs[b]], work);
            values.copy_from_slice(value);
            derivatives.copy_from_slice(derivative);
        }
    }
}

/// Columns of the last layer, given as row-major [channel, l], put in the order \[l\]\[channel\] with
/// whole lanes of channels: the column of the file at each place, if there is one.
pub(super) fn column_by_order(n_channels: usize, n_orders: usize, place: usize) -> Option<usize> {
    let width = lanes_for(n_channels) * LANES;
    let (l, n) = (place / width, place % width);
    (n < n_channels).then_some(n * n_orders + l)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn network() -> RadialNetwork {
        let element = |i: usize, o: usize| ((5 * i + 3 * o) % 13) as f64 / 13.0 - 0.45;
        RadialNetwork {
            basis_size: 5,
            envelope_exponent: 16,
            layers: vec![
                Matrix::from_fn(5, 12, element),
                Matrix::from_fn(12, 12, element),
                Matrix::from_fn(12, 9, element),
            ],
        }
    }

    #[test]
    fn derivatives_of_the_network_are_differences() {
        let (network, cutoff, h) = (network(), 5.0, 1e-4);
        let jet = |r: f64| network.evaluate(r, cutoff, &mut RadialWork::default()).clone();
        for r in [0.4, 2.3, 3.9, 4.99] {
            let (centre, plus, minus) = (jet(r), jet(r + h), jet(r - h));
            for order in 0..2 {
                for k in 0..9 {
                    let at = |jet: &Jet| jet[order].as_flattened()[k];
                    let difference = (at(&plus) - at(&minus)) / (2.0 * h);
                    let derivative = centre[order + 1].as_flattened()[k];
                    assert!(
                        (difference - derivative).abs() < 1e-5 * (1.0 + derivative.abs()),
                        "{r} {order} {k}"
                    );
                }
            }
        }
        assert!(jet(5.0).iter().flatten().flatten().all(|x| *x == 0.0));
    }

    #[test]
    fn the_table_keeps_its_stated_error_everywhere() {
        let (network, cutoff) = (network(), 5.0);
        let table = RadialTable::new(&network, cutoff);
        let stated = table.errors();
        assert!(stated[0] <= 1e-11 && stated[1] <= 1e-11, "{stated:?}");
        let (mut work, mut worst) = (RadialWork::default(), [0.0_f64; 2]);
        let (mut largest, n) = ([0.0_f64; 2], network.output_lanes());
        let (mut values, mut derivatives) = (vec![ZERO; n], vec![ZERO; n]);
        for k in 0..5000 {
            let r = cutoff * (k as f64 + 0.37) / 5000.0;
            let exact = network.evaluate(r, cutoff, &mut work);
            table.evaluate_one(r, &mut values, &mut derivatives);
            for (order, found) in [&values, &derivatives].into_iter().enumerate() {
                for (f, e) in found.as_flattened().iter().zip(exact[order].as_flattened()) {
                    worst[order] = worst[order].max((f - e).abs());
                    largest[order] = largest[order].max(e.abs());
                }
            }
        }
        for order in 0..2 {
            let error = worst[order] / largest[order];
            // The bound is measured where the error is largest, up to the variation within an interval.
            assert!(error <= 1.2 * stated[order] + 1e-15, "{order}: {error:e}, stated {:e}", stated[order]);
        }
    }
}
