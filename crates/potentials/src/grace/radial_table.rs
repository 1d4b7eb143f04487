//! Tables of radial functions: splines of degree seven.

use super::instructions::{Instructions, SimdPass};
use super::radial_network::{RadialNetwork, RadialWork};
use super::vector::{Double, Number, Vector, to_lanes};

/// Initial and maximum number of intervals.
const INTERVALS: std::ops::RangeInclusive<usize> = 256..=16384;

/// Degree of the spline.
const DEGREE: usize = 7;

/// DEGREE!
const FACTORIAL: f64 = 5040.0;

/// Number of B-splines that are nonzero within an interval.
pub(super) const SUPPORT: usize = DEGREE + 1;

/// Roots of the B-spline polynomial inside the unit circle (M. Unser, A. Aldroubi and M. Eden,
/// IEEE Trans. Signal Process. 41, 821 (1993)).
const POLES: [f64; 3] = [-0.535_280_430_796_438_2, -0.122_554_615_192_326_69, -0.009_148_694_809_608_277];

/// Number of samples beyond both ends, over which the effect of the unknown end conditions decays: the largest
/// pole to this power is 10⁻¹⁷.
pub(super) const MARGIN: usize = 64;

/// R_nl(r) for one cutoff as the spline Σ_k c_k β(r/h − k), where β is the cardinal B-spline of degree seven,
/// through the exact values at the equidistant knots r = k h. It has six continuous derivatives, and forces use
/// its own derivative, so energy is conserved.
#[derive(Clone, Debug)]
pub(super) struct RadialTable<V> {
    cutoff: f64,
    intervals: usize,
    /// 1/h, 1/Å
    knots_per_length: f64,
    errors: [f64; 2],
    /// Lanes of a row with all R_nl of a bond.
    lanes: usize,
    /// c_k from k = −3, `[intervals + 7, lanes]`.
    coefficients: Vec<V>,
}

impl RadialTable<Double> {
    /// Halves the spacing until the errors of values and derivatives, relative to the largest, are at most
    /// `target`.
    pub fn new(network: &RadialNetwork, cutoff: f64, pair: usize, target: f64) -> Self {
        let mut table = Self::with_intervals(network, cutoff, pair, *INTERVALS.start());
        let is_coarse = |table: &Self| table.errors.iter().any(|error| *error > target);
        while is_coarse(&table) && table.intervals < *INTERVALS.end() {
            table = Self::with_intervals(network, cutoff, pair, 2 * table.intervals);
        }
        table
    }

    /// The network is smooth beyond both ends, so samples are taken there too.
    fn with_intervals(network: &RadialNetwork, cutoff: f64, pair: usize, intervals: usize) -> Self {
        let mut work = RadialWork::default();
        let (lanes, knots_per_length) = (network.output_lanes(), intervals as f64 / cutoff);
        let coefficients = Vec::new();
        let mut table = Self { cutoff, intervals, knots_per_length, errors: [0.0; 2], lanes, coefficients };
        let mut samples = Vec::new();
        for r in table.knots() {
            samples.extend_from_slice(&network.evaluate(r, cutoff, pair, &mut work)[0]);
        }
        table.interpolate(&mut samples);
        table.errors = table.measure(network, pair);
        table
    }

    /// r of the knots, of which there are more beyond both ends, Å.
    pub fn knots(&self) -> impl Iterator<Item = f64> + use<> {
        let spacing = self.cutoff / self.intervals as f64;
        (0..=self.intervals + 2 * MARGIN).map(move |k| (k as f64 - MARGIN as f64) * spacing)
    }

    /// Passes the spline through these values at the knots, `[knots, lanes]`, which it overwrites.
    pub fn interpolate(&mut self, samples: &mut [Double]) {
        to_coefficients(samples, self.lanes);
        let kept = (MARGIN - 3) * self.lanes..(MARGIN + self.intervals + 4) * self.lanes;
        self.coefficients.clear();
        self.coefficients.extend_from_slice(&samples[kept]);
    }

    /// The derivatives with respect to the values at the knots, `[knots, lanes]`, from those with respect to the
    /// coefficients.
    pub fn of_samples(&self, of_coefficients: &[Double]) -> Vec<Double> {
        let (lanes, knots) = (self.lanes, self.intervals + 1 + 2 * MARGIN);
        let mut of_samples = vec![Double::ZERO; knots * lanes];
        of_samples[(MARGIN - 3) * lanes..][..of_coefficients.len()].copy_from_slice(of_coefficients);
        transposed_to_coefficients(&mut of_samples, lanes);
        of_samples
    }

    /// Adds the contribution of one bond to the derivatives with respect to the coefficients, `[intervals + 7,
    /// lanes]`, from those with respect to R_nl and dR_nl/dr, each a row. The bond is given as in
    /// [`RadialTable::combine`].
    #[inline(always)]
    pub fn add_gradient(
        &self,
        interval: usize,
        bond: usize,
        (weights, slopes): &([Double; SUPPORT], [Double; SUPPORT]),
        [of_values, of_derivatives]: [&[Double]; 2],
        sums: &mut [Double],
    ) {
        let rows = &mut sums[interval * self.lanes..][..SUPPORT * self.lanes];
        for (k, row) in rows.chunks_exact_mut(self.lanes).enumerate() {
            let (weight, slope) = (weights[k][bond], slopes[k][bond] * self.knots_per_length);
            for (sum, (v, d)) in row.iter_mut().zip(of_values.iter().zip(of_derivatives)) {
                sum.add_scaled(weight, v);
                sum.add_scaled(slope, d);
            }
        }
    }

    /// Number of vectors of coefficients.
    pub fn size(&self) -> usize {
        self.coefficients.len()
    }

    /// The largest errors of values and derivatives between knots, relative to the largest of each. They occur
    /// near the middle and near the quarters of an interval.
    fn measure(&self, network: &RadialNetwork, pair: usize) -> [f64; 2] {
        let mut work = RadialWork::default();
        let mut found = [vec![Double::ZERO; self.lanes], vec![Double::ZERO; self.lanes]];
        let (mut errors, mut largest) = ([0.0_f64; 2], [f64::MIN_POSITIVE; 2]);
        for k in 0..2 * self.intervals {
            let within = if k % 2 == 0 { 0.5 } else { 0.25 };
            let r = ((k / 2) as f64 + within) * self.cutoff / self.intervals as f64;
            let [values, derivatives] = &mut found;
            self.evaluate_one(r, values, derivatives);
            let exact = network.evaluate(r, self.cutoff, pair, &mut work);
            for (order, found) in found.iter().enumerate() {
                for (found, exact) in Double::flat(found).iter().zip(Double::flat(&exact[order])) {
                    errors[order] = errors[order].max((found - exact).abs());
                    largest[order] = largest[order].max(exact.abs());
                }
            }
        }
        [errors[0] / largest[0], errors[1] / largest[1]]
    }

    /// The table with coefficients in another precision.
    pub fn rounded<V: Vector>(&self) -> RadialTable<V> {
        let Self { cutoff, intervals, knots_per_length, errors, .. } = *self;
        let coefficients = to_lanes(Double::flat(&self.coefficients));
        let lanes = self.lanes * Double::LANES / V::LANES;
        RadialTable { cutoff, intervals, knots_per_length, errors, lanes, coefficients }
    }
}

impl<V: Vector> RadialTable<V> {
    /// The cutoff of the table, Å.
    pub fn cutoff(&self) -> f64 {
        self.cutoff
    }

    /// Its size in memory.
    pub fn bytes(&self) -> usize {
        size_of_val(&self.coefficients[..])
    }

    /// Number of intervals between r = 0 and the cutoff.
    pub fn intervals(&self) -> usize {
        self.intervals
    }

    /// The measured errors of values and derivatives, relative to the largest of each.
    pub fn errors(&self) -> [f64; 2] {
        self.errors
    }

    /// The interval of r and the position in it, from 0 to 1; 0 ≤ r ≤ cutoff, Å.
    #[inline(always)]
    pub fn locate(&self, r: f64) -> (usize, f64) {
        let position = r * self.knots_per_length;
        let interval = (position as usize).min(self.intervals - 1);
        (interval, position - interval as f64)
    }

    /// Σ_k weights\[k\]\[bond\] c_(interval + k), all R_nl of one bond, and dR_nl/dr likewise.
    #[inline(always)]
    pub fn combine(
        &self,
        interval: usize,
        bond: usize,
        (weights, slopes): &([V; SUPPORT], [V; SUPPORT]),
        values: &mut [V],
        derivatives: &mut [V],
    ) {
        let n = self.lanes;
        let rows = &self.coefficients[interval * n..][..SUPPORT * n];
        let whole = n / LANES_PER_PASS * LANES_PER_PASS;
        let knots_per_length = V::Number::round(self.knots_per_length);
        let weights = (weights.map(|w| w[bond]), slopes.map(|s| s[bond] * knots_per_length));
        for c in (0..whole).step_by(LANES_PER_PASS) {
            sum_of_rows::<V, LANES_PER_PASS>(
                &rows[c..],
                n,
                &weights,
                &mut values[c..],
                &mut derivatives[c..],
            );
        }
        for c in whole..n {
            sum_of_rows::<V, 1>(&rows[c..], n, &weights, &mut values[c..], &mut derivatives[c..]);
        }
    }

    /// R_nl(r) and its derivative.
    pub fn evaluate_one(&self, r: f64, values: &mut [V], derivatives: &mut [V]) {
        Instructions::best().run(One { table: self, r, values, derivatives });
    }
}

/// A single bond, for callers compiled for the baseline.
struct One<'a, V> {
    table: &'a RadialTable<V>,
    r: f64,
    values: &'a mut [V],
    derivatives: &'a mut [V],
}

impl<V: Vector> SimdPass for One<'_, V> {
    #[inline(always)]
    fn run(self, _: bool) {
        let (interval, t) = self.table.locate(self.r);
        self.table.combine(
            interval,
            0,
            &b_splines(&V::splat(V::Number::round(t))),
            self.values,
            self.derivatives,
        );
    }
}

/// Adjacent lanes of a row that are summed together.
const LANES_PER_PASS: usize = 4;

/// Σ_k weights\[k\] of row k, for `L` lanes of rows that are `n` lanes apart, with two sets of weights.
#[inline(always)]
fn sum_of_rows<V: Vector, const L: usize>(
    rows: &[V],
    n: usize,
    (weights, slopes): &([V::Number; SUPPORT], [V::Number; SUPPORT]),
    values: &mut [V],
    derivatives: &mut [V],
) {
    let (mut sums, mut slope_sums) = ([V::ZERO; L], [V::ZERO; L]);
    for k in 0..SUPPORT {
        let row = &rows[k * n..][..L];
        for l in 0..L {
            sums[l].add_scaled(weights[k], &row[l]);
            slope_sums[l].add_scaled(slopes[k], &row[l]);
        }
    }
    values[..L].copy_from_slice(&sums);
    derivatives[..L].copy_from_slice(&slope_sums);
}

/// The B-splines of degree p = 7 within an interval and their derivatives, at position t of a bond in each
/// lane: p b_j^p = (p − j + t) b_(j−1)^(p−1) + (j + 1 − t) b_j^(p−1) and db_j^p/dt = b_(j−1)^(p−1) − b_j^(p−1).
#[inline(always)]
pub(super) fn b_splines<V: Vector>(t: &V) -> ([V; SUPPORT], [V; SUPPORT]) {
    let round = V::Number::round;
    let (mut b, mut slopes) = ([V::ZERO; SUPPORT], [V::ZERO; SUPPORT]);
    b[0] = V::splat(round(1.0 / FACTORIAL));
    for p in 1..=DEGREE {
        let mut before = V::ZERO;
        for j in 0..=p {
            let (here, mut next, mut slope) = (b[j], V::ZERO, V::ZERO);
            for k in 0..V::LANES {
                let (rising, falling) = (round((p - j) as f64) + t[k], round((j + 1) as f64) - t[k]);
                next[k] = rising * before[k] + falling * here[k];
                slope[k] = round(DEGREE as f64) * (before[k] - here[k]);
            }
            slopes[j] = slope;
            (before, b[j]) = (here, next);
        }
    }
    (b, slopes)
}

/// The transpose of [`to_coefficients`].
fn transposed_to_coefficients(of_coefficients: &mut [Double], lanes: usize) {
    let x = of_coefficients;
    for z in POLES.into_iter().rev() {
        for k in 0..x.len() - lanes {
            let here = x[k];
            x[k + lanes].add_scaled(z, &here);
            x[k] = here.scaled(-z);
        }
        for k in (lanes..x.len()).rev() {
            let here = x[k];
            x[k - lanes].add_scaled(z, &here);
        }
    }
    let gain: f64 = POLES.iter().map(|z| (1.0 - z) * (1.0 - 1.0 / z)).product();
    Double::flat_mut(x).iter_mut().for_each(|x| *x *= gain);
}

/// Converts samples at equidistant knots, `[knots, lanes]`, to spline coefficients by the recursive filter of
/// Unser, Aldroubi and Eden; near the ends they satisfy another end condition.
fn to_coefficients(samples: &mut [Double], lanes: usize) {
    let gain: f64 = POLES.iter().map(|z| (1.0 - z) * (1.0 - 1.0 / z)).product();
    Double::flat_mut(samples).iter_mut().for_each(|x| *x *= gain);
    for z in POLES {
        for k in lanes..samples.len() {
            let before = samples[k - lanes];
            samples[k].add_scaled(z, &before);
        }
        for k in (0..samples.len() - lanes).rev() {
            let after = samples[k + lanes];
            (0..Double::LANES).for_each(|l| samples[k][l] = z * (after[l] - samples[k][l]));
        }
    }
}
