//! Normalisation of an equivariant tensor before it is sent to neighbours.

use super::tape::{TapeSlot, Tensor};
use super::vector::{Number, Vector};

/// y_w,n = a_w,n x′_w,n / √(mean_n Σ_w d_w x′² + ε), where x′ is x, minus its mean over channels in the
/// rotationally invariant components.
#[derive(Clone, Debug)]
pub(super) struct EquivariantNorm<V> {
    /// x
    pub from: Tensor,
    /// y, of the same shape
    pub to: Tensor,
    /// 1 for components whose mean is subtracted, 0 for others.
    pub centred: Vec<f64>,
    /// d
    pub degree_weights: Vec<f64>,
    /// a, \[w\]\[channel\], zero in the padding.
    pub affine: Vec<V>,
    /// ε
    pub floor: f64,
}

impl<V: Vector> EquivariantNorm<V> {
    /// Rows of x with the mean over channels to subtract.
    #[inline(always)]
    fn rows<'a>(&'a self, x: &'a [V], slot: TapeSlot) -> impl Iterator<Item = (usize, &'a [V], f64)> {
        self.centred.iter().enumerate().map(move |(w, centred)| {
            let row = &x[slot.row(&self.from, w)..][..self.from.width];
            (w, row, centred * self.mean(row))
        })
    }

    /// Mean over channels.
    #[inline(always)]
    fn mean(&self, row: &[V]) -> f64 {
        row.iter().map(|x| x.horizontal_sum().into()).sum::<f64>() / self.from.channels as f64
    }

    /// x′ of lane `c`, zero in the padding.
    #[inline(always)]
    fn centre(&self, x: &V, mean: f64, c: usize) -> V {
        let mut out = *x;
        let (mean, filled) = (V::Number::round(mean), (self.from.channels - c * V::LANES).min(V::LANES));
        (0..filled).for_each(|k| out[k] -= mean);
        out
    }

    /// (mean_n Σ_w d_w x′² + ε)^(−1/2)
    #[inline(always)]
    fn inverse(&self, tape: &[V], slot: TapeSlot) -> f64 {
        let mut square = 0.0;
        for (w, row, mean) in self.rows(tape, slot) {
            let mut sum = V::ZERO;
            for (c, x) in row.iter().enumerate() {
                let x = self.centre(x, mean, c);
                sum.add_product(&x, &x);
            }
            square += self.degree_weights[w] * sum.horizontal_sum().into();
        }
        1.0 / (square / self.from.channels as f64 + self.floor).sqrt()
    }

    #[inline(always)]
    pub fn forward(&self, atoms: usize, tape: &mut [V]) {
        let (before, out) = tape.split_at_mut(self.to.start * atoms);
        for slot in (0..atoms).map(|slot| TapeSlot { slot, slots: atoms }) {
            let inverse = self.inverse(before, slot);
            for (w, row, mean) in self.rows(before, slot) {
                let first = slot.row(&self.to, w) - self.to.start * atoms;
                for (c, x) in row.iter().enumerate() {
                    let x = self.centre(x, mean, c).scaled(V::Number::round(inverse));
                    out[first + c] = x.product(&self.affine[w * self.to.width + c]);
                }
            }
        }
    }

    /// Adds to the cotangents of x. With the inverse root i, x̄′ = i a ȳ − i³ d_w x′/n_channels Σ a ȳ x′, minus
    /// its mean over channels where the mean of x was subtracted.
    #[inline(always)]
    pub fn backward<const N: usize>(&self, atoms: usize, tape: &[V], cotangent: &mut [V]) {
        for k in 0..N * atoms {
            let of_tape = TapeSlot { slot: k % atoms, slots: atoms };
            self.backward_one(tape, of_tape, cotangent, TapeSlot { slot: k, slots: N * atoms });
        }
    }

    #[inline(always)]
    fn backward_one(&self, tape: &[V], of_tape: TapeSlot, cotangent: &mut [V], slot: TapeSlot) {
        let inverse = self.inverse(tape, of_tape);
        let mut along = V::ZERO;
        for (w, row, mean) in self.rows(tape, of_tape) {
            let out = &cotangent[slot.row(&self.to, w)..];
            for (c, x) in row.iter().enumerate() {
                let ay = out[c].product(&self.affine[w * self.to.width + c]);
                along.add_product(&ay, &self.centre(x, mean, c));
            }
        }
        let along = along.horizontal_sum().into() * inverse.powi(3) / self.from.channels as f64;
        for (w, row, mean) in self.rows(tape, of_tape) {
            let (first, out) = (slot.row(&self.from, w), slot.row(&self.to, w));
            let mut sum = 0.0_f64;
            for (c, x) in row.iter().enumerate() {
                let ay = cotangent[out + c].product(&self.affine[w * self.to.width + c]);
                let mut of_x = ay.scaled(V::Number::round(inverse));
                let factor = V::Number::round(-along * self.degree_weights[w]);
                of_x.add_scaled(factor, &self.centre(x, mean, c));
                sum += of_x.horizontal_sum().into();
                cotangent[first + c].add(&of_x);
            }
            let mean = self.centred[w] * sum / self.from.channels as f64;
            for (c, x) in cotangent[first..first + self.from.width].iter_mut().enumerate() {
                *x = self.centre(x, mean, c);
            }
        }
    }

    /// As [`super::tape::TapeOperation::keep`]; the components are needed together.
    pub fn keep(&self, needed: &mut [bool]) {
        if self.to.rows().any(|row| needed[row]) {
            self.from.rows().for_each(|row| needed[row] = true);
        }
    }

    /// As [`super::tape::TapeOperation::rename`]; both tensors have the same lanes on both tapes.
    pub fn rename(&mut self, on_tape: impl Fn(u32) -> u32) {
        for tensor in [&mut self.from, &mut self.to] {
            tensor.start = on_tape(tensor.start as u32) as usize;
        }
    }
}
