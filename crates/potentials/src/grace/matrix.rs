//! The matrix product behind all dense operations.

use std::ops::Range;

use super::instructions::{Instructions, SimdPass};
use super::vector::{Number, Vector, lanes_for};

/// A matrix `[inputs × outputs]` whose outputs are stored in panels of [`Vector::LANES`] columns.
#[derive(Clone, Debug)]
pub(super) struct Matrix<V> {
    inputs: usize,
    outputs: usize,
    /// `[panels × inputs]`
    panels: Vec<V>,
}

impl<V: Vector> Matrix<V> {
    /// From rounded values of `element(input, output)`.
    pub fn from_fn(inputs: usize, outputs: usize, element: impl Fn(usize, usize) -> f64) -> Self {
        let mut panels = vec![V::ZERO; lanes_for::<V>(outputs) * inputs];
        for output in 0..outputs {
            for input in 0..inputs {
                let panel = &mut panels[output / V::LANES * inputs + input];
                panel[output % V::LANES] = V::Number::round(element(input, output));
            }
        }
        Self { inputs, outputs, panels }
    }

    /// The transpose.
    pub fn transposed(&self) -> Self {
        let at = |i: usize, o: usize| self.panels[o / V::LANES * self.inputs + i][o % V::LANES].into();
        Self::from_fn(self.outputs, self.inputs, |o, i| at(i, o))
    }

    /// Inputs times outputs.
    pub fn size(&self) -> u64 {
        self.inputs as u64 * self.outputs as u64
    }

    /// Number of inputs.
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// Lanes of one row of inputs.
    pub fn input_lanes(&self) -> usize {
        lanes_for::<V>(self.inputs)
    }

    /// Lanes of one row of outputs.
    pub fn output_lanes(&self) -> usize {
        self.panels.len() / self.inputs.max(1)
    }

    /// Adds another matrix of the same shape.
    pub fn add(&mut self, other: &Self) {
        for (x, y) in self.panels.iter_mut().zip(&other.panels) {
            x.add(y);
        }
    }

    /// Adds x M to the rows `to` for the rows x in `from`.
    pub fn multiply_add(
        &self,
        lanes: impl MatrixOperands<V>,
        from: StridedRows,
        to: StridedRows,
        instructions: Instructions,
    ) {
        assert_eq!(from.len(), to.len());
        instructions.run(Multiply { matrix: self, lanes, from, to, factors: None });
    }

    /// The same after multiplying each row of `to` by its factor.
    pub fn scale_multiply_add(
        &self,
        lanes: impl MatrixOperands<V>,
        from: StridedRows,
        (to, factors): (StridedRows, Factors),
        instructions: Instructions,
    ) {
        assert_eq!(from.len(), to.len());
        instructions.run(Multiply { matrix: self, lanes, from, to, factors: Some(factors) });
    }

    /// Processes `PANELS` panels at a time, which stay in the L1 cache for all rows.
    #[inline(always)]
    fn multiply_panels<const ROWS: usize, const PANELS: usize>(
        &self,
        inputs: Range<usize>,
        lanes: &mut impl MatrixOperands<V>,
        from: StridedRows,
        (to, factors): (StridedRows, Option<Factors>),
    ) {
        let n = self.output_lanes();
        let panel = |p: usize| &self.panels[p * self.inputs..][inputs.clone()];
        let mut p = 0;
        while p + PANELS <= n {
            let panels: [&[V]; PANELS] = std::array::from_fn(|k| panel(p + k));
            multiply_rows::<V, ROWS, PANELS>(panels, inputs.start, lanes, from, (to.after(p), factors));
            p += PANELS;
        }
        for p in p..n {
            multiply_rows::<V, ROWS, 1>([panel(p)], inputs.start, lanes, from, (to.after(p), factors));
        }
    }
}

/// x M, compiled once for all callers.
struct Multiply<'a, V, L> {
    matrix: &'a Matrix<V>,
    lanes: L,
    from: StridedRows<'a>,
    to: StridedRows<'a>,
    factors: Option<Factors<'a>>,
}

impl<V: Vector, L: MatrixOperands<V>> SimdPass for Multiply<'_, V, L> {
    /// Uses larger blocks if there are registers for them, which changes no bits.
    #[inline(always)]
    fn run(self, wide: bool) {
        let Self { matrix, mut lanes, from, to, factors } = self;
        for first in (0..matrix.inputs).step_by(INNER_BLOCK) {
            let inputs = first..matrix.inputs.min(first + INNER_BLOCK);
            let to = (to, factors.filter(|_| first == 0));
            if wide {
                matrix.multiply_panels::<8, 2>(inputs, &mut lanes, from, to);
            } else {
                matrix.multiply_panels::<4, 1>(inputs, &mut lanes, from, to);
            }
        }
    }
}

/// A number per row.
#[derive(Clone, Copy, Debug)]
pub(super) struct Factors<'a> {
    pub numbers: &'a [f64],
    /// Distance between the numbers of consecutive rows.
    pub stride: usize,
}

/// The arrays to read rows from and to add rows to, which may be the same.
pub(super) trait MatrixOperands<V> {
    fn read(&self) -> &[V];
    fn write(&mut self) -> &mut [V];
}

impl<V> MatrixOperands<V> for (&[V], &mut [V]) {
    #[inline(always)]
    fn read(&self) -> &[V] {
        self.0
    }

    #[inline(always)]
    fn write(&mut self) -> &mut [V] {
        self.1
    }
}

impl<V> MatrixOperands<V> for &mut [V] {
    #[inline(always)]
    fn read(&self) -> &[V] {
        self
    }

    #[inline(always)]
    fn write(&mut self) -> &mut [V] {
        self
    }
}

/// Number of inputs between writes of the results, so that a pair of panels stays in the L1 cache.
const INNER_BLOCK: usize = 256;

/// Rows of an array: component r of slot s starts at lane `starts[r]` · `slots` + s · `stride` + `shift`.
#[derive(Clone, Copy, Debug)]
pub(super) struct StridedRows<'a> {
    /// Where each component starts for a single slot.
    pub starts: &'a [u32],
    /// Number of atoms (times cotangents).
    pub slots: usize,
    /// Lanes between the rows of consecutive atoms.
    pub stride: usize,
    /// Lanes to skip at the start.
    pub shift: usize,
}

impl StridedRows<'static> {
    /// One row for each of `slots` atoms.
    #[inline(always)]
    pub fn of_atoms(slots: usize, stride: usize) -> Self {
        Self { starts: &[0], slots, stride, shift: 0 }
    }
}

impl StridedRows<'_> {
    #[inline(always)]
    fn len(&self) -> usize {
        self.starts.len() * self.slots
    }

    #[inline(always)]
    fn after(mut self, lanes: usize) -> Self {
        self.shift += lanes;
        self
    }

    /// First lanes of `N` rows from the given one.
    #[inline(always)]
    fn block<const N: usize>(&self, first: usize) -> [usize; N] {
        let (mut r, mut s) = (first / self.slots, first % self.slots);
        let mut lanes = [0; N];
        // A closure for `array::from_fn` is not always inlined.
        for lane in &mut lanes {
            *lane = self.starts[r] as usize * self.slots + s * self.stride + self.shift;
            s += 1;
            if s == self.slots {
                (r, s) = (r + 1, 0);
            }
        }
        lanes
    }
}

/// Processes `ROWS` rows at a time, then the rest.
#[inline(always)]
fn multiply_rows<V: Vector, const ROWS: usize, const PANELS: usize>(
    panels: [&[V]; PANELS],
    first_input: usize,
    lanes: &mut impl MatrixOperands<V>,
    from: StridedRows,
    to: (StridedRows, Option<Factors>),
) {
    let (n, mut row) = (from.len(), 0);
    while row + ROWS <= n {
        multiply_block::<V, ROWS, PANELS>(panels, first_input, lanes, from, to, row);
        row += ROWS;
    }
    if ROWS > 4 && row + 4 <= n {
        multiply_block::<V, 4, PANELS>(panels, first_input, lanes, from, to, row);
        row += 4;
    }
    if row + 2 <= n {
        multiply_block::<V, 2, PANELS>(panels, first_input, lanes, from, to, row);
        row += 2;
    }
    if row < n {
        multiply_block::<V, 1, PANELS>(panels, first_input, lanes, from, to, row);
    }
}

/// Multiplies a block of rows by a block of panels, with the sums in registers.
#[inline(always)]
fn multiply_block<V: Vector, const ROWS: usize, const PANELS: usize>(
    panels: [&[V]; PANELS],
    first_input: usize,
    lanes: &mut impl MatrixOperands<V>,
    from: StridedRows,
    (to, factors): (StridedRows, Option<Factors>),
    row: usize,
) {
    let (x, inputs) = (V::flat(lanes.read()), panels[0].len());
    let (from, to): ([usize; ROWS], [usize; ROWS]) = (from.block(row), to.block(row));
    let rows: [&[V::Number]; ROWS] =
        std::array::from_fn(|r| &x[from[r] * V::LANES + first_input..][..inputs]);
    let panels = panels.map(|panel| &panel[..inputs]);
    let mut sums = [[V::ZERO; PANELS]; ROWS];
    for i in 0..inputs {
        for r in 0..ROWS {
            for p in 0..PANELS {
                sums[r][p].add_scaled(rows[r][i], &panels[p][i]);
            }
        }
    }
    let out = lanes.write();
    if let Some(Factors { numbers, stride }) = factors {
        for (r, to) in to.into_iter().enumerate() {
            let factor = V::Number::round(numbers[(row + r) * stride]);
            for out in &mut out[to..to + PANELS] {
                *out = out.scaled(factor);
            }
        }
    }
    for (to, sums) in to.into_iter().zip(&sums) {
        for (out, sum) in out[to..to + PANELS].iter_mut().zip(sums) {
            out.add(sum);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::vector::{Double, Single, to_lanes};
    use super::*;

    /// Two components of `slots` atoms each.
    fn rows(starts: &[u32], slots: usize, stride: usize) -> StridedRows<'_> {
        StridedRows { starts, slots, stride, shift: 0 }
    }

    #[test]
    fn the_blocked_product_is_the_product() {
        check::<Double>();
        check::<Single>();
    }

    fn check<V: Vector>() {
        for (inputs, outputs) in [(1, 1), (5, 9), (8, 8), (13, 24), (2 * INNER_BLOCK + 3, 17)] {
            let element = |i: usize, o: usize| ((3 * i + 7 * o) % 11) as f64 - 4.5;
            let matrix = Matrix::<V>::from_fn(inputs, outputs, element);
            let ways = |slots| Instructions::all().into_iter().map(move |instructions| (slots, instructions));
            for (slots, instructions) in (1..=9_usize).flat_map(ways) {
                let (xl, yl) = (lanes_for::<V>(inputs), lanes_for::<V>(outputs));
                let numbers: Vec<f64> =
                    (0..2 * slots * xl * V::LANES).map(|k| (k % 7) as f64 - 3.0).collect();
                let x: Vec<V> = to_lanes(&numbers);
                let mut out = vec![V::splat(V::Number::round(1.0)); 2 * slots * yl];
                let (from, to) = ([0, xl as u32], [yl as u32, 0]);
                let (from, to) = (rows(&from, slots, xl), rows(&to, slots, yl));
                matrix.multiply_add((&x[..], &mut out[..]), from, to, instructions);
                for (r, o) in (0..2 * slots).flat_map(|r| (0..outputs).map(move |o| (r, o))) {
                    let row = &numbers[r * xl * V::LANES..];
                    let direct: f64 = (0..inputs).map(|i| row[i] * element(i, o)).sum();
                    // Swap the components.
                    let to = (r + slots) % (2 * slots);
                    assert_eq!(V::flat(&out)[to * yl * V::LANES + o].into(), 1.0 + direct);
                }
            }
        }
    }
}
