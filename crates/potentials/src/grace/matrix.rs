//! Numbers in lanes, and the one matrix product that everything dense goes through.
//!
//! Channels are the innermost index of every array, padded with zeros to whole [`Lanes`]. Loops over
//! a lane array have a fixed length, so the compiler turns them into vector instructions; additions
//! keep their written order whatever the width of the processor's vectors, so the bits do too. Products are added
//! with one rounding.

use std::ops::Range;

use super::instructions::{Instructions, Pass};

/// Channels that are worked on together.
pub(super) const LANES: usize = 8;

/// [`LANES`] neighbouring channels (or, for spherical harmonics, bonds).
pub(super) type Lanes = [f64; LANES];

/// Nothing in any lane.
pub(super) const ZERO: Lanes = [0.0; LANES];

/// How many [`Lanes`] hold `channels` numbers.
pub(super) fn lanes_for(channels: usize) -> usize {
    channels.div_ceil(LANES)
}

/// `channels` as whole lanes, padded with zeros.
pub(super) fn to_lanes(channels: &[f64]) -> Vec<Lanes> {
    let mut lanes = vec![ZERO; lanes_for(channels.len())];
    lanes.as_flattened_mut()[..channels.len()].copy_from_slice(channels);
    lanes
}

/// sum += s x, lane by lane. (Lanes are copied before they are worked on, which tells the compiler that
/// it may use vectors.)
#[inline(always)]
pub(super) fn add_scaled(sum: &mut Lanes, s: f64, x: &Lanes) {
    let (mut out, x) = (*sum, *x);
    for k in 0..LANES {
        out[k] = s.mul_add(x[k], out[k]);
    }
    *sum = out;
}

/// sum += x y, lane by lane.
#[inline(always)]
pub(super) fn add_product(sum: &mut Lanes, x: &Lanes, y: &Lanes) {
    let (mut out, x, y) = (*sum, *x, *y);
    for k in 0..LANES {
        out[k] = x[k].mul_add(y[k], out[k]);
    }
    *sum = out;
}

/// x y, lane by lane.
#[inline(always)]
pub(super) fn product(x: &Lanes, y: &Lanes) -> Lanes {
    let (mut out, y) = (*x, *y);
    for k in 0..LANES {
        out[k] *= y[k];
    }
    out
}

/// s x, lane by lane.
#[inline(always)]
pub(super) fn scaled(s: f64, x: &Lanes) -> Lanes {
    let mut out = *x;
    for x in &mut out {
        *x *= s;
    }
    out
}

/// Σ over lanes, pairwise.
#[inline(always)]
pub(super) fn horizontal_sum(x: &Lanes) -> f64 {
    ((x[0] + x[4]) + (x[2] + x[6])) + ((x[1] + x[5]) + (x[3] + x[7]))
}

/// A matrix [inputs × outputs], its outputs in panels of [`LANES`] columns.
#[derive(Clone, Debug)]
pub(super) struct Matrix {
    inputs: usize,
    outputs: usize,
    /// [panels × inputs]
    panels: Vec<Lanes>,
}

impl Matrix {
    /// From `element(input, output)`.
    pub fn from_fn(inputs: usize, outputs: usize, element: impl Fn(usize, usize) -> f64) -> Self {
        let mut panels = vec![ZERO; lanes_for(outputs) * inputs];
        for output in 0..outputs {
            for input in 0..inputs {
                panels[output / LANES * inputs + input][output % LANES] = element(input, output);
            }
        }
        Self { inputs, outputs, panels }
    }

    /// Inputs times outputs.
    pub fn size(&self) -> u64 {
        self.inputs as u64 * self.outputs as u64
    }

    /// Lanes of one row of inputs.
    pub fn input_lanes(&self) -> usize {
        lanes_for(self.inputs)
    }

    /// Lanes of one row of outputs.
    pub fn output_lanes(&self) -> usize {
        self.panels.len() / self.inputs.max(1)
    }

    /// Adds another matrix of the same shape.
    pub fn add(&mut self, other: &Self) {
        for (x, y) in self.panels.iter_mut().zip(&other.panels) {
            add_scaled(x, 1.0, y);
        }
    }

    /// Adds x M to the rows `to` of `out`, x being the rows `from` of `x`, as many.
    pub fn multiply_add(
        &self,
        x: &[Lanes],
        from: Rows,
        out: &mut [Lanes],
        to: Rows,
        instructions: Instructions,
    ) {
        assert_eq!(from.len(), to.len());
        instructions.run(Multiply { matrix: self, x, from, out, to });
    }

    /// `PANELS` panels at a time, which stay in the first cache for all rows.
    #[inline(always)]
    fn multiply_panels<const ROWS: usize, const PANELS: usize>(
        &self,
        inputs: Range<usize>,
        x: &[Lanes],
        from: Rows,
        out: &mut [Lanes],
        to: Rows,
    ) {
        let lanes = self.output_lanes();
        let panel = |p: usize| &self.panels[p * self.inputs..][inputs.clone()];
        let mut p = 0;
        while p + PANELS <= lanes {
            let panels: [&[Lanes]; PANELS] = std::array::from_fn(|k| panel(p + k));
            multiply_rows::<ROWS, PANELS>(panels, inputs.start, x, from, out, to.after(p));
            p += PANELS;
        }
        for p in p..lanes {
            multiply_rows::<ROWS, 1>([panel(p)], inputs.start, x, from, out, to.after(p));
        }
    }
}

/// x M, compiled once for all who need it.
struct Multiply<'a> {
    matrix: &'a Matrix,
    x: &'a [Lanes],
    from: Rows<'a>,
    out: &'a mut [Lanes],
    to: Rows<'a>,
}

impl Pass for Multiply<'_> {
    /// Blocks are larger where there are registers for them, which changes no bits.
    #[inline(always)]
    fn run(self, wide: bool) {
        let Self { matrix, x, from, out, to } = self;
        for first in (0..matrix.inputs).step_by(INNER_BLOCK) {
            let inputs = first..matrix.inputs.min(first + INNER_BLOCK);
            if wide {
                matrix.multiply_panels::<8, 2>(inputs, x, from, out, to);
            } else {
                matrix.multiply_panels::<4, 1>(inputs, x, from, out, to);
            }
        }
    }
}

/// Inputs that are worked on before the results are written: few enough for a pair of panels to stay in the first
/// cache.
const INNER_BLOCK: usize = 256;

/// Rows of an array: that of component r and slot s begins at lane `starts[r]` · `slots` + s · `stride` + `shift`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rows<'a> {
    /// Where each component begins if there is one slot.
    pub starts: &'a [u32],
    /// Number of atoms (times cotangents).
    pub slots: usize,
    /// Lanes from one atom's row to the next.
    pub stride: usize,
    /// Lanes to be left out at the beginning.
    pub shift: usize,
}

impl Rows<'static> {
    /// A row for each of `slots` atoms.
    #[inline(always)]
    pub fn of_atoms(slots: usize, stride: usize) -> Self {
        Self { starts: &[0], slots, stride, shift: 0 }
    }
}

impl Rows<'_> {
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
        std::array::from_fn(|_| {
            let lane = self.starts[r] as usize * self.slots + s * self.stride + self.shift;
            s += 1;
            if s == self.slots {
                (r, s) = (r + 1, 0);
            }
            lane
        })
    }
}

/// `ROWS` rows at a time, then fewer.
#[inline(always)]
fn multiply_rows<const ROWS: usize, const PANELS: usize>(
    panels: [&[Lanes]; PANELS],
    first_input: usize,
    x: &[Lanes],
    from: Rows,
    out: &mut [Lanes],
    to: Rows,
) {
    let (n, mut row) = (from.len(), 0);
    while row + ROWS <= n {
        multiply_block::<ROWS, PANELS>(panels, first_input, x, from.block(row), out, to.block(row));
        row += ROWS;
    }
    if ROWS > 4 && row + 4 <= n {
        multiply_block::<4, PANELS>(panels, first_input, x, from.block(row), out, to.block(row));
        row += 4;
    }
    if row + 2 <= n {
        multiply_block::<2, PANELS>(panels, first_input, x, from.block(row), out, to.block(row));
        row += 2;
    }
    if row < n {
        multiply_block::<1, PANELS>(panels, first_input, x, from.block(row), out, to.block(row));
    }
}

/// Some rows times some panels, the sums in registers.
#[inline(always)]
fn multiply_block<const ROWS: usize, const PANELS: usize>(
    panels: [&[Lanes]; PANELS],
    first_input: usize,
    x: &[Lanes],
    from: [usize; ROWS],
    out: &mut [Lanes],
    to: [usize; ROWS],
) {
    let (x, inputs) = (x.as_flattened(), panels[0].len());
    let rows: [&[f64]; ROWS] = std::array::from_fn(|r| &x[from[r] * LANES + first_input..][..inputs]);
    let panels = panels.map(|panel| &panel[..inputs]);
    let mut sums = [[ZERO; PANELS]; ROWS];
    for i in 0..inputs {
        for r in 0..ROWS {
            for p in 0..PANELS {
                add_scaled(&mut sums[r][p], rows[r][i], &panels[p][i]);
            }
        }
    }
    for (to, sums) in to.into_iter().zip(&sums) {
        for (out, sum) in out[to..to + PANELS].iter_mut().zip(sums) {
            add_scaled(out, 1.0, sum);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two components of `slots` atoms each.
    fn rows(starts: &[u32], slots: usize, stride: usize) -> Rows<'_> {
        Rows { starts, slots, stride, shift: 0 }
    }

    #[test]
    fn the_blocked_product_is_the_product() {
        for (inputs, outputs) in [(1, 1), (5, 9), (8, 8), (13, 24), (2 * INNER_BLOCK + 3, 17)] {
            let element = |i: usize, o: usize| ((3 * i + 7 * o) % 11) as f64 - 4.5;
            let matrix = Matrix::from_fn(inputs, outputs, element);
            let ways = |slots| Instructions::all().into_iter().map(move |instructions| (slots, instructions));
            for (slots, instructions) in (1..=9_usize).flat_map(ways) {
                let (xl, yl) = (lanes_for(inputs), lanes_for(outputs));
                let mut x = vec![ZERO; 2 * slots * xl];
                x.as_flattened_mut().iter_mut().enumerate().for_each(|(k, x)| *x = (k % 7) as f64 - 3.0);
                let mut out = vec![[1.0; LANES]; 2 * slots * yl];
                let (from, to) = ([0, xl as u32], [yl as u32, 0]);
                let (from, to) = (rows(&from, slots, xl), rows(&to, slots, yl));
                matrix.multiply_add(&x, from, &mut out, to, instructions);
                for (r, o) in (0..2 * slots).flat_map(|r| (0..outputs).map(move |o| (r, o))) {
                    let direct: f64 =
                        (0..inputs).map(|i| x.as_flattened()[r * xl * LANES + i] * element(i, o)).sum();
                    // The components change places.
                    let to = (r + slots) % (2 * slots);
                    assert_eq!(out.as_flattened()[to * yl * LANES + o], 1.0 + direct);
                }
            }
        }
    }
}
