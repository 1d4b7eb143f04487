//! The normalisation of an equivariant tensor before it is sent to neighbours.

use super::matrix::{LANES, Lanes, add_product, add_scaled, horizontal_sum, product, scaled};
use super::tape::Tensor;

/// y_w,n = a_w,n x′_w,n / √(mean_n Σ_w d_w x′² + ε), where x′ is x, or x without its mean over channels in the
/// components that do not change under rotation.
#[derive(Clone, Debug)]
pub(super) struct EquivariantNorm {
    /// x
    pub from: Tensor,
    /// y, of the same shape
    pub to: Tensor,
    /// 1 for components whose mean is taken away, 0 for others.
    pub centred: Vec<f64>,
    /// d
    pub degree_weights: Vec<f64>,
    /// a, \[w\]\[channel\], zero in the padding.
    pub affine: Vec<Lanes>,
    /// ε
    pub floor: f64,
}

impl EquivariantNorm {
    /// Rows of x with the mean over channels that is taken away.
    #[inline(always)]
    fn rows<'a>(&'a self, x: &'a [Lanes]) -> impl Iterator<Item = (usize, &'a [Lanes], f64)> {
        let rows = x[self.from.start..self.from.end()].chunks_exact(self.from.width);
        rows.zip(&self.centred).enumerate().map(|(w, (row, centred))| (w, row, centred * self.mean(row)))
    }

    /// Mean over channels.
    #[inline(always)]
    fn mean(&self, row: &[Lanes]) -> f64 {
        row.iter().map(horizontal_sum).sum::<f64>() / self.from.channels as f64
    }

    /// x′ of lane `c`, zero in the padding.
    #[inline(always)]
    fn centre(&self, x: &Lanes, mean: f64, c: usize) -> Lanes {
        let mut out = *x;
        let filled = (self.from.channels - c * LANES).min(LANES);
        out[..filled].iter_mut().for_each(|x| *x -= mean);
        out
    }

    /// (mean_n Σ_w d_w x′² + ε)^(−1/2)
    #[inline(always)]
    fn inverse(&self, tape: &[Lanes]) -> f64 {
        let mut square = 0.0;
        for (w, row, mean) in self.rows(tape) {
            let mut sum = [0.0; LANES];
            for (c, x) in row.iter().enumerate() {
                let x = self.centre(x, mean, c);
                add_product(&mut sum, &x, &x);
            }
            square += self.degree_weights[w] * horizontal_sum(&sum);
        }
        1.0 / (square / self.from.channels as f64 + self.floor).sqrt()
    }

    #[inline(always)]
    pub fn forward(&self, tape: &mut [Lanes]) {
        let inverse = self.inverse(tape);
        let (before, out) = tape.split_at_mut(self.to.start);
        for (w, row, mean) in self.rows(before) {
            for (c, x) in row.iter().enumerate() {
                let place = w * self.to.width + c;
                let x = scaled(inverse, &self.centre(x, mean, c));
                out[place] = product(&x, &self.affine[place]);
            }
        }
    }

    /// Adds to the cotangent of x: with the inverse root i,
    /// x̄′ = i a ȳ − i³ d_w x′/n_channels Σ a ȳ x′, from which the mean over channels is taken away as it was from x.
    #[inline(always)]
    pub fn backward(&self, tape: &[Lanes], cotangent: &mut [Lanes]) {
        let inverse = self.inverse(tape);
        let (before, out) = cotangent.split_at_mut(self.to.start);
        let mut along = [0.0; LANES];
        for (w, row, mean) in self.rows(tape) {
            for (c, x) in row.iter().enumerate() {
                let place = w * self.to.width + c;
                let ay = product(&out[place], &self.affine[place]);
                add_product(&mut along, &ay, &self.centre(x, mean, c));
            }
        }
        let along = horizontal_sum(&along) * inverse.powi(3) / self.from.channels as f64;
        for (w, row, mean) in self.rows(tape) {
            let first = self.from.row(w);
            let mut sum = 0.0;
            for (c, x) in row.iter().enumerate() {
                let place = w * self.to.width + c;
                let mut of_x = scaled(inverse, &product(&out[place], &self.affine[place]));
                add_scaled(&mut of_x, -along * self.degree_weights[w], &self.centre(x, mean, c));
                sum += horizontal_sum(&of_x);
                add_scaled(&mut before[first + c], 1.0, &of_x);
            }
            let mean = self.centred[w] * sum / self.from.channels as f64;
            for (c, x) in before[first..first + self.from.width].iter_mut().enumerate() {
                *x = self.centre(x, mean, c);
            }
        }
    }

    /// As [`super::tape::Operation::keep`]: the components are needed together.
    pub fn keep(&self, needed: &mut [bool]) {
        if (0..self.to.components).any(|w| needed[self.to.row(w)]) {
            (0..self.from.components).for_each(|w| needed[self.from.row(w)] = true);
        }
    }
}
