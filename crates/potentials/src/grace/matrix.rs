//! Numbers in lanes, and the one matrix product that everything dense goes through.
//!
//! Channels are the innermost index of every array, padded with zeros to whole [`Lanes`]. Loops over
//! a lane array have a fixed length, so the compiler turns them into vector instructions; additions
//! keep their written order whatever the width of the processor's vectors, so the bits do too.

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
        out[k] += s * x[k];
    }
    *sum = out;
}

/// sum += x y, lane by lane.
#[inline(always)]
pub(super) fn add_product(sum: &mut Lanes, x: &Lanes, y: &Lanes) {
    let (mut out, x, y) = (*sum, *x, *y);
    for k in 0..LANES {
        out[k] += x[k] * y[k];
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
        Self { inputs, panels }
    }

    /// Lanes of one row of outputs.
    pub fn output_lanes(&self) -> usize {
        self.panels.len() / self.inputs.max(1)
    }

    /// Adds x M to `out` for several rows: row r of x begins at lane `from[r]` of `x`, its result is
    /// added at lane `to[r]` of `out`.
    #[inline(always)]
    pub fn multiply_add(&self, x: &[Lanes], from: &[u32], out: &mut [Lanes], to: &[u32]) {
        assert_eq!(from.len(), to.len());
        let x = x.as_flattened();
        for (p, panel) in self.panels.chunks_exact(self.inputs.max(1)).enumerate() {
            let mut rows = from.chunks_exact(4).zip(to.chunks_exact(4));
            for (from, to) in &mut rows {
                multiply_rows::<4>(panel, x, from, out, to, p);
            }
            let done = from.len() / 4 * 4;
            let (from, to) = (&from[done..], &to[done..]);
            match from.len() {
                3 => multiply_rows::<3>(panel, x, from, out, to, p),
                2 => multiply_rows::<2>(panel, x, from, out, to, p),
                1 => multiply_rows::<1>(panel, x, from, out, to, p),
                _ => {}
            }
        }
    }

    /// [`Matrix::multiply_add`] for one row at the beginning of `x` and of `out`.
    #[inline(always)]
    pub fn multiply_add_row(&self, x: &[Lanes], out: &mut [Lanes]) {
        self.multiply_add(x, &[0], out, &[0]);
    }
}

#[inline(always)]
fn multiply_rows<const ROWS: usize>(
    panel: &[Lanes],
    x: &[f64],
    from: &[u32],
    out: &mut [Lanes],
    to: &[u32],
    panel_index: usize,
) {
    let rows: [&[f64]; ROWS] = std::array::from_fn(|r| &x[from[r] as usize * LANES..][..panel.len()]);
    let mut sums = [ZERO; ROWS];
    for (i, weights) in panel.iter().enumerate() {
        for r in 0..ROWS {
            add_scaled(&mut sums[r], rows[r][i], weights);
        }
    }
    for r in 0..ROWS {
        add_scaled(&mut out[to[r] as usize + panel_index], 1.0, &sums[r]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_blocked_product_is_the_product() {
        for (inputs, outputs) in [(1, 1), (5, 9), (8, 8), (13, 24)] {
            let element = |i: usize, o: usize| ((3 * i + 7 * o) % 11) as f64 - 4.5;
            let matrix = Matrix::from_fn(inputs, outputs, element);
            for rows in 1..=9_usize {
                let (xl, yl) = (lanes_for(inputs), lanes_for(outputs));
                let mut x = vec![ZERO; rows * xl];
                x.as_flattened_mut().iter_mut().enumerate().for_each(|(k, x)| *x = (k % 7) as f64 - 3.0);
                let mut out = vec![[1.0; LANES]; rows * yl];
                let offsets = |stride: usize| (0..rows).map(|r| (r * stride) as u32).collect::<Vec<_>>();
                matrix.multiply_add(&x, &offsets(xl), &mut out, &offsets(yl));
                for r in 0..rows {
                    for o in 0..outputs {
                        let direct: f64 =
                            (0..inputs).map(|i| x.as_flattened()[r * xl * LANES + i] * element(i, o)).sum();
                        assert_eq!(out.as_flattened()[r * yl * LANES + o], 1.0 + direct);
                    }
                }
            }
        }
    }
}
