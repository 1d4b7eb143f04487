//! A regression model of label costs, fitted to the labels made so far:
//!
//! ln t = β₀ + β₁ ln x + β₂ ln k + noise,
//!
//! where t is in core-seconds, x is the number of electrons (of atoms if the electrons of any label are
//! unknown), and k the number of k-points. Priors: β₁ = 2 ± 0.75, because plane-wave codes scale between
//! linearly and cubically; β₂ = 1 ± 0.25; β₀ is uninformative, so the first label determines it and later
//! labels refine the rest. The noise follows a Student t distribution with four degrees of freedom, so a label
//! that took a hundred times longer than similar ones has little weight. Its scale is estimated too; the prior
//! scale is [`PRIOR_NOISE_SCALE`].

mod fit;
#[cfg(test)]
mod tests;

use fit::{Fit, Normal};

/// What the cost of a label depends on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CostPredictors {
    /// Number of atoms.
    pub atoms: f64,
    /// Number of electrons treated; `None` if unknown.
    pub electrons: Option<f64>,
    /// Number of k-points.
    pub k_points: f64,
}

/// A finished label and its cost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeasuredCost {
    /// Size of the calculation.
    pub size: CostPredictors,
    /// Its cost.
    pub core_seconds: f64,
}

/// A user's estimate before any label exists; trusted within a factor of three.
pub type Guess = MeasuredCost;

/// Predicted cost of one label or of several together, core-seconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Predicted {
    /// Expected cost.
    pub core_seconds: f64,
    /// Lower end of the 90 % prediction interval.
    pub low: f64,
    /// Upper end of the interval.
    pub high: f64,
}

/// The fitted cost model.
#[derive(Clone, Debug)]
pub struct CostModel {
    by_electrons: bool,
    centre: [f64; 2],
    fit: Fit,
}

/// Priors of β₁ and β₂: mean and standard deviation.
const EXPONENT_PRIORS: [Normal; 2] = [Normal { mean: 2.0, sd: 0.75 }, Normal { mean: 1.0, sd: 0.25 }];

/// Prior scale of the noise: a factor of 1.3.
const PRIOR_NOISE_SCALE: f64 = 0.26;

/// Standard deviation of a user's estimate, on the logarithmic scale.
const GUESS_SIGMA: f64 = 1.098_612_288_668_109_8;

/// 95 % quantile of Student's t distribution with four degrees of freedom.
const STUDENT_95: f64 = 2.131_846_786_326_649;
/// 95 % quantile of the normal distribution.
const NORMAL_95: f64 = 1.644_853_626_951_472_2;

impl CostModel {
    /// Fits the model to finished labels and a user's estimate; `None` without either. Labels whose size or
    /// cost is not positive are ignored.
    pub fn fit(measured: &[MeasuredCost], guess: Option<Guess>) -> Option<Self> {
        let is_usable = |label: &&MeasuredCost| label.size.is_usable() && is_positive(label.core_seconds);
        let labels: Vec<_> = measured.iter().filter(is_usable).collect();
        let guess = guess.filter(|guess| is_usable(&guess));
        let known = || labels.iter().copied().chain(&guess);
        let by_electrons = known().all(|label| label.size.electrons.is_some());
        let number = known().count() as f64;
        let mut centre = [0.0; 2];
        for label in known() {
            let logarithms = label.size.logarithms(by_electrons);
            centre.iter_mut().zip(logarithms).for_each(|(centre, x)| *centre += x / number);
        }
        let point = |label: &MeasuredCost| {
            let [x, k] = label.size.logarithms(by_electrons);
            ([1.0, x - centre[0], k - centre[1]], label.core_seconds.ln())
        };
        let points: Vec<_> = labels.iter().map(|label| point(label)).collect();
        let fit = Fit::new(&points, guess.as_ref().map(point))?;
        Some(Self { by_electrons, centre, fit })
    }

    /// Number of labels in the fit.
    pub fn labels(&self) -> usize {
        self.fit.points
    }

    /// Predicts one label; `None` if the size is not positive.
    pub fn predict(&self, size: &CostPredictors) -> Option<Predicted> {
        let row = self.row(size)?;
        let middle = self.fit.at(&row);
        let away = STUDENT_95 * (self.fit.scale.powi(2) + self.fit.variance(&row)).sqrt();
        let core_seconds = middle.exp() * self.fit.mean_factor;
        Some(Predicted { core_seconds, low: (middle - away).exp(), high: (middle + away).exp() })
    }

    /// Predicts the total of labels, given as (size, number). Labels without a usable size are assumed to cost
    /// the mean of the others; `None` if no size is usable.
    pub fn predict_all(&self, sizes: impl IntoIterator<Item = (CostPredictors, u64)>) -> Option<Predicted> {
        let (mut sum, mut noise, mut gradient) = (0.0, 0.0, [0.0; 3]);
        let (mut known, mut all) = (0.0, 0.0);
        for (size, number) in sizes {
            let number = number as f64;
            all += number;
            let Some(row) = self.row(&size) else { continue };
            known += number;
            let each = self.fit.at(&row).exp() * self.fit.mean_factor;
            sum += number * each;
            // The noise of each label is independent; the uncertainty of β is common to all.
            noise += number * each * each * self.fit.relative_variance();
            gradient.iter_mut().zip(row).for_each(|(total, x)| *total += number * each * x);
        }
        if known == 0.0 {
            return None;
        }
        let relative = gradient.map(|part| part / sum);
        let variance = self.fit.variance(&relative) + (1.0 + noise / (sum * sum)).ln();
        let away = (NORMAL_95 * variance.sqrt()).exp();
        let core_seconds = sum * all / known;
        Some(Predicted { core_seconds, low: core_seconds / away, high: core_seconds * away })
    }

    fn row(&self, size: &CostPredictors) -> Option<[f64; 3]> {
        let is_known = size.is_usable() && (!self.by_electrons || size.electrons.is_some());
        let [x, k] = size.logarithms(self.by_electrons);
        is_known.then_some([1.0, x - self.centre[0], k - self.centre[1]])
    }
}

impl CostPredictors {
    fn is_usable(&self) -> bool {
        is_positive(self.atoms) && is_positive(self.k_points) && self.electrons.is_none_or(is_positive)
    }

    fn logarithms(&self, by_electrons: bool) -> [f64; 2] {
        let particles = self.electrons.filter(|_| by_electrons).unwrap_or(self.atoms);
        [particles.ln(), self.k_points.ln()]
    }
}

fn is_positive(x: f64) -> bool {
    x.is_finite() && x > 0.0
}
