//! Activation functions with their derivatives, in double precision.

/// The activation function of a perceptron.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Activation {
    /// x / (1 + e^−x)
    Silu,
    /// tanh x
    Tanh,
}

impl Activation {
    /// Value and derivative.
    #[inline(always)]
    pub fn evaluate(self, x: f64) -> (f64, f64) {
        match self {
            Self::Silu => {
                let s = 1.0 / (1.0 + (-x).exp());
                (x * s, s * (1.0 + x * (1.0 - s)))
            }
            Self::Tanh => {
                let t = x.tanh();
                (t, 1.0 - t * t)
            }
        }
    }

    /// The second derivative.
    #[inline(always)]
    pub fn curvature(self, x: f64) -> f64 {
        match self {
            Self::Silu => {
                let s = 1.0 / (1.0 + (-x).exp());
                s * (1.0 - s) * (2.0 + x * (1.0 - 2.0 * s))
            }
            Self::Tanh => {
                let t = x.tanh();
                -2.0 * t * (1.0 - t * t)
            }
        }
    }
}
