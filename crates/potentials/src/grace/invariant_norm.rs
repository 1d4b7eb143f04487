//! Normalisation of a layer's invariants before the sum over layers.

use super::vector::Number;

/// Keeps the norm differentiable where all invariants vanish.
pub(super) const SQUARE_FLOOR: f64 = 1e-10;

/// y_k = s_k x_k / √(mean x² + 10⁻¹⁰), with the mean over the same channels; channel 0 may be excluded.
#[derive(Clone, Debug)]
pub(super) struct InvariantNorm {
    /// The factor of channel 0 if it is excluded.
    pub linear: Option<f64>,
    /// s of the other channels.
    pub scale: Vec<f64>,
    /// Name of s in the file.
    pub array: String,
}

impl InvariantNorm {
    /// The first channel that is normalised.
    pub fn first(&self) -> usize {
        usize::from(self.linear.is_some())
    }

    /// The normalised channels, and (mean x² + 10⁻¹⁰)^(−1/2).
    #[inline(always)]
    fn inverse<'a, T: Number>(&self, x: &'a [T]) -> (&'a [T], f64) {
        let x = &x[self.first()..][..self.scale.len()];
        let squares = x.iter().map(|x| (*x).into()).map(|x: f64| x * x);
        let mean = squares.sum::<f64>() / x.len().max(1) as f64;
        (x, 1.0 / (mean + SQUARE_FLOOR).sqrt())
    }

    /// Adds y to `sum`.
    #[inline(always)]
    pub fn forward<T: Number>(&self, x: &[T], sum: &mut [T]) {
        if let Some(factor) = self.linear {
            sum[0] += T::round(factor * x[0].into());
        }
        let (normalised, inverse) = self.inverse(x);
        for ((sum, x), scale) in sum[self.first()..].iter_mut().zip(normalised).zip(&self.scale) {
            *sum += T::round((*x).into() * inverse * scale);
        }
    }

    /// Replaces the cotangent of y with that of x: x̄_k = i s_k ȳ_k − i³ x_k/n Σ_j s_j ȳ_j x_j with the inverse
    /// root i.
    #[inline(always)]
    pub fn backward<T: Number>(&self, x: &[T], cotangent: &mut [T]) {
        if let Some(factor) = self.linear {
            cotangent[0] *= T::round(factor);
        }
        let (x, inverse) = self.inverse(x);
        let cotangent = &mut cotangent[self.first()..];
        let mut along = 0.0;
        for ((c, x), scale) in cotangent.iter_mut().zip(x).zip(&self.scale) {
            *c *= T::round(scale * inverse);
            along += (*c).into() * (*x).into();
        }
        along *= inverse * inverse / x.len().max(1) as f64;
        cotangent.iter_mut().zip(x).for_each(|(c, x)| *c -= T::round(along * (*x).into()));
    }
}
