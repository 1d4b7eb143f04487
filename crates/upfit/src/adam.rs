//! The optimiser.

use serde::{Deserialize, Serialize};

/// Decay of the mean of the gradient and of that of its square (Kingma & Ba, ICLR 2015).
const DECAY: [f64; 2] = [0.9, 0.999];
/// Added to the root of the mean square.
const EPSILON: f64 = 1e-8;

/// Adam (Kingma & Ba, ICLR 2015) with the largest mean square so far in place of the present one (AMSGrad; Reddi, Kale &
/// Kumar, ICLR 2018). Both means are corrected for their start at zero.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AdamState {
    steps: u64,
    /// Mean of the gradient, one number for each weight.
    mean: Vec<f64>,
    /// Mean of its square.
    square: Vec<f64>,
    /// The largest of these.
    largest: Vec<f64>,
}

impl AdamState {
    /// Before the first step of this many weights.
    pub fn new(weights: usize) -> Self {
        let zeros = || vec![0.0; weights];
        Self { steps: 0, mean: zeros(), square: zeros(), largest: zeros() }
    }

    /// Number of steps made.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Changes the weights that are not frozen.
    ///
    /// # Panics
    /// If a list has another length.
    pub fn step(&mut self, weights: &mut [f64], gradient: &[f64], rate: f64, frozen: &[bool]) {
        let n = self.mean.len();
        assert!([weights.len(), gradient.len(), frozen.len()] == [n; 3], "one number for each weight");
        self.steps += 1;
        let power = i32::try_from(self.steps).unwrap_or(i32::MAX);
        let [mean_share, square_share] = DECAY.map(|decay| 1.0 - decay.powi(power));
        for k in (0..n).filter(|k| !frozen[*k]) {
            let g = gradient[k];
            self.mean[k] = DECAY[0] * self.mean[k] + (1.0 - DECAY[0]) * g;
            self.square[k] = DECAY[1] * self.square[k] + (1.0 - DECAY[1]) * g * g;
            self.largest[k] = self.largest[k].max(self.square[k]);
            let scale = (self.largest[k] / square_share).sqrt() + EPSILON;
            weights[k] -= rate * self.mean[k] / mean_share / scale;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_those_by_hand() {
        let mut adam = AdamState::new(3);
        let mut weights = [1.0, 2.0, 3.0];
        let frozen = [false, false, true];
        // The first step is the rate in the direction of each gradient.
        adam.step(&mut weights, &[0.5, -4.0, 1.0], 0.1, &frozen);
        for (weight, expected) in weights.iter().zip([0.9, 2.1, 3.0]) {
            assert!((weight - expected).abs() < 1e-8, "{weights:?}");
        }
        // g = 0.5, then 0.1: m = 0.9 · 0.05 + 0.1 · 0.1 = 0.055, m̂ = 0.055 / 0.19;
        // v = 0.999 · 0.00025 + 0.001 · 0.01 = 0.00025975, which is the largest, v̂ = 0.00025975 / 0.001999.
        adam.step(&mut weights, &[0.1, 0.0, 1.0], 0.1, &frozen);
        let first = 0.1 * (0.055 / 0.19) / (0.00025975_f64 / 0.001999).sqrt();
        // g = −4, then 0: m = −0.36, v falls from 0.016 to 0.015984, so that 0.016 remains.
        let second = 0.1 * (-0.36 / 0.19) / (0.016_f64 / 0.001999).sqrt();
        for (weight, expected) in weights.iter().zip([0.9 - first, 2.1 - second, 3.0]) {
            assert!((weight - expected).abs() < 1e-7, "{weights:?} {first} {second}");
        }
        assert_eq!(adam.steps(), 2);
    }

    #[test]
    fn a_parabola_is_descended() {
        let mut adam = AdamState::new(2);
        let mut weights = [3.0, -2.0];
        for _ in 0..2000 {
            let gradient = [2.0 * (weights[0] - 1.0), 20.0 * weights[1]];
            adam.step(&mut weights, &gradient, 0.02, &[false; 2]);
        }
        assert!((weights[0] - 1.0).abs() < 1e-3 && weights[1].abs() < 1e-3, "{weights:?}");
    }
}
