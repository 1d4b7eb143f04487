//! Mean absolute and root mean square deviations.

/// Sums over differences.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Deviations {
    pub number: f64,
    absolute: f64,
    square: f64,
}

impl Deviations {
    pub fn add(&mut self, difference: f64) {
        self.number += 1.0;
        self.absolute += difference.abs();
        self.square += difference * difference;
    }

    /// Adds all differences of `other`, `times` times.
    pub fn merge(&mut self, other: &Self, times: u32) {
        let times = f64::from(times);
        self.number += times * other.number;
        self.absolute += times * other.absolute;
        self.square += times * other.square;
    }

    /// Mean absolute deviation; `None` without differences.
    pub fn mean_absolute(&self) -> Option<f64> {
        (self.number > 0.0).then(|| self.absolute / self.number)
    }

    /// Root mean square deviation; `None` without differences.
    pub fn root_mean_square(&self) -> Option<f64> {
        (self.number > 0.0).then(|| (self.square / self.number).sqrt())
    }
}
