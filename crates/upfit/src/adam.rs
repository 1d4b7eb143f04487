//! The optimiser.

use serde::{Deserialize, Serialize};

/// Decay of the mean of the gradient and of that of its square (Kingma & Ba, ICLR 2015).
const DECAY: [f64; 2] = [0.9, 0.999];
/// Added to the root of the mean square, as in Keras.
const EPSILON: f64 = 1e-7;

/// Adam (Kingma & Ba, ICLR 2015) with the largest mean square so far in place of the present one (AMSGrad; Reddi, Kale &
/// Kumar, ICLR 2018). Both means are corrected for their start at zero; as in Keras, the largest is taken before the correction.
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
        let rate = rate * square_share.sqrt() / mean_share;
        for k in (0..n).filter(|k| !frozen[*k]) {
            let g = gradient[k];
            self.mean[k] = DECAY[0] * self.mean[k] + (1.0 - DECAY[0]) * g;
            self.square[k] = DECAY[1] * self.square[k] + (1.0 - DECAY[1]) * g * g;
            self.largest[k] = self.largest[k].max(self.square[k]);
            weights[k] -= rate * self.mean[k] / (self.largest[k].sqrt() + EPSILON);
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
        // g = 0.5: m = 0.05, v = 0.00025; g = −4: m = −0.4, v = 0.016. But for the small number, the step is the rate in the
        // direction of each gradient.
        adam.step(&mut weights, &[0.5, -4.0, 1.0], 0.1, &frozen);
        let rate = 0.1 * 0.001_f64.sqrt() / 0.1;
        let first = 1.0 - rate * 0.05 / (0.00025_f64.sqrt() + 1e-7);
        let second = 2.0 + rate * 0.4 / (0.016_f64.sqrt() + 1e-7);
        assert!((first - 0.9).abs() < 1e-6 && (second - 2.1).abs() < 1e-6, "{first} {second}");
        for (weight, expected) in weights.iter().zip([first, second, 3.0]) {
            assert!((weight - expected).abs() < 1e-12, "{weights:?}");
        }
        // g = 0.5, then 0.1: m = 0.9 · 0.05 + 0.1 · 0.1 = 0.055, v = 0.999 · 0.00025 + 0.001 · 0.01 = 0.00025975, the largest.
        // g = −4, then 0: m = −0.36, v falls from 0.016 to 0.015984, so that 0.016 remains.
        adam.step(&mut weights, &[0.1, 0.0, 1.0], 0.1, &frozen);
        let rate = 0.1 * 0.001999_f64.sqrt() / 0.19;
        let first = first - rate * 0.055 / (0.00025975_f64.sqrt() + 1e-7);
        let second = second + rate * 0.36 / (0.016_f64.sqrt() + 1e-7);
        for (weight, expected) in weights.iter().zip([first, second, 3.0]) {
            assert!((weight - expected).abs() < 1e-12, "{weights:?} {first} {second}");
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
