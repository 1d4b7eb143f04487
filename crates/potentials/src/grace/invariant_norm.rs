//! The normalisation of a layer's invariants before they are summed over layers.

/// Keeps the norm differentiable where all invariants vanish.
const SQUARE_FLOOR: f64 = 1e-10;

/// y_k = s_k x_k / √(mean x² + 10⁻¹⁰), the mean over the same channels; channel 0 may stay out of it.
#[derive(Clone, Debug)]
pub(super) struct InvariantNorm {
    /// The factor of channel 0 where it is not normalised.
    pub linear: Option<f64>,
    /// s of the other channels.
    pub scale: Vec<f64>,
}

impl InvariantNorm {
    fn first(&self) -> usize {
        usize::from(self.linear.is_some())
    }

    /// Channels that are normalised, and (mean x² + 10⁻¹⁰)^(−1/2).
    #[inline(always)]
    fn inverse<'a>(&self, x: &'a [f64]) -> (&'a [f64], f64) {
        let x = &x[self.first()..][..self.scale.len()];
        let mean = x.iter().map(|x| x * x).sum::<f64>() / x.len().max(1) as f64;
        (x, 1.0 / (mean + SQUARE_FLOOR).sqrt())
    }

    /// Adds y to `sum`.
    #[inline(always)]
    pub fn forward(&self, x: &[f64], sum: &mut [f64]) {
        if let Some(factor) = self.linear {
            sum[0] += factor * x[0];
        }
        let (normalised, inverse) = self.inverse(x);
        for ((sum, x), scale) in sum[self.first()..].iter_mut().zip(normalised).zip(&self.scale) {
            *sum += x * inverse * scale;
        }
    }

    /// The cotangent of x from that of y, in place:
    /// x̄_k = i s_k ȳ_k − i³ x_k/n Σ_j s_j ȳ_j x_j with the inverse root i.
    #[inline(always)]
    pub fn backward(&self, x: &[f64], cotangent: &mut [f64]) {
        if let Some(factor) = self.linear {
            cotangent[0] *= factor;
        }
        let (x, inverse) = self.inverse(x);
        let cotangent = &mut cotangent[self.first()..];
        let mut along = 0.0;
        for ((c, x), scale) in cotangent.iter_mut().zip(x).zip(&self.scale) {
            *c *= scale * inverse;
            along += *c * x;
        }
        along *= inverse * inverse / x.len().max(1) as f64;
        cotangent.iter_mut().zip(x).for_each(|(c, x)| *c -= along * x);
    }
}
