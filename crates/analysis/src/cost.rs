//! What labels cost, learned from those that were made.
//!
//! ln t = β₀ + β₁ ln x + β₂ ln k + noise,
//!
//! t in core-seconds, x the electrons (the atoms if electrons are not known of every label), k the points of the mesh. Before
//! anything is measured β₁ is taken for 2 ± 0.75, since plane-wave codes are between linear and cubic, and β₂ for 1 ± 0.25;
//! about β₀ nothing is assumed. The first label settles β₀, later ones settle the rest. The noise has a
//! Student distribution with four degrees of freedom, so a label that took a hundred times as long as its like is
//! believed little; its scale is learned as well, and taken for [`SCATTER`] before.

mod fit;
#[cfg(test)]
mod tests;

use fit::{Fit, Normal};

/// What the cost of a label depends on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Size {
    /// Atoms.
    pub atoms: f64,
    /// Electrons that are treated; `None` if that is not known.
    pub electrons: Option<f64>,
    /// Points of the k-point mesh.
    pub k_points: f64,
}

/// A label that was made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured {
    /// Of what size.
    pub size: Size,
    /// What it took.
    pub core_seconds: f64,
}

/// What somebody expects of a label before there is any: believed within a factor of three.
pub type Guess = Measured;

/// What a label, or several together, will take, core-seconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Predicted {
    /// On average.
    pub core_seconds: f64,
    /// With 90 % it is more than this …
    pub low: f64,
    /// … and less than this.
    pub high: f64,
}

/// What is known of the cost of labels.
#[derive(Clone, Debug)]
pub struct CostModel {
    by_electrons: bool,
    centre: [f64; 2],
    fit: Fit,
}

/// Prior of β₁ and β₂: mean and standard deviation.
const EXPONENTS: [Normal; 2] = [Normal { mean: 2.0, sd: 0.75 }, Normal { mean: 1.0, sd: 0.25 }];

/// Scale of the noise before anything is known of it: a factor of 1.3.
const SCATTER: f64 = 0.26;

/// What a guess is believed to, as a logarithm.
const GUESS: f64 = 1.098_612_288_668_109_8;

/// Of Student's distribution with four degrees of freedom, 95 % lie below so many scales.
const STUDENT_95: f64 = 2.131_846_786_326_649;
/// The same of a normal distribution.
const NORMAL_95: f64 = 1.644_853_626_951_472_2;

impl CostModel {
    /// From labels that were made, and from what was guessed. `None` if there is neither: then nothing is known. Labels
    /// whose size or cost is not above 0 are left out.
    pub fn fit(measured: &[Measured], guess: Option<Guess>) -> Option<Self> {
        let is_usable = |label: &&Measured| label.size.is_usable() && is_positive(label.core_seconds);
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
        let point = |label: &Measured| {
            let [x, k] = label.size.logarithms(by_electrons);
            ([1.0, x - centre[0], k - centre[1]], label.core_seconds.ln())
        };
        let points: Vec<_> = labels.iter().map(|label| point(label)).collect();
        let fit = Fit::new(&points, guess.as_ref().map(point))?;
        Some(Self { by_electrons, centre, fit })
    }

    /// Labels that it has learned from.
    pub fn labels(&self) -> usize {
        self.fit.points
    }

    /// One label of that size; `None` if the size is not above 0.
    pub fn predict(&self, size: &Size) -> Option<Predicted> {
        let row = self.row(size)?;
        let middle = self.fit.at(&row);
        let away = STUDENT_95 * (self.fit.scale.powi(2) + self.fit.variance(&row)).sqrt();
        let core_seconds = middle.exp() * self.fit.mean_factor;
        Some(Predicted { core_seconds, low: (middle - away).exp(), high: (middle + away).exp() })
    }

    /// Labels of these sizes together, so many of each; those without a usable size are taken for what the others take
    /// on average. `None` if none has one.
    pub fn predict_all(&self, sizes: impl IntoIterator<Item = (Size, u64)>) -> Option<Predicted> {
        let (mut sum, mut noise, mut gradient) = (0.0, 0.0, [0.0; 3]);
        let (mut known, mut all) = (0.0, 0.0);
        for (size, number) in sizes {
            let number = number as f64;
            all += number;
            let Some(row) = self.row(&size) else { continue };
            known += number;
            let each = self.fit.at(&row).exp() * self.fit.mean_factor;
            sum += number * each;
            // Each differs from its expectation by itself; all differ alike by what is not known of β.
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

    fn row(&self, size: &Size) -> Option<[f64; 3]> {
        let is_known = size.is_usable() && (!self.by_electrons || size.electrons.is_some());
        let [x, k] = size.logarithms(self.by_electrons);
        is_known.then_some([1.0, x - self.centre[0], k - self.centre[1]])
    }
}

impl Size {
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
