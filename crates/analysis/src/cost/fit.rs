//! Linear regression with a normal prior and Student t noise.

use super::{EXPONENT_PRIORS, GUESS_SIGMA, PRIOR_NOISE_SCALE};

type Matrix3x3 = [[f64; 3]; 3];

/// (1, ln x, ln k) and the logarithm of the cost.
pub(super) type CostPoint = ([f64; 3], f64);

/// A normal prior.
pub(super) struct Normal {
    pub mean: f64,
    pub sd: f64,
}

/// The posterior.
#[derive(Clone, Debug)]
pub(super) struct Fit {
    pub coefficients: [f64; 3],
    covariance: Matrix3x3,
    /// Scale of the noise.
    pub scale: f64,
    /// Mean / median of the cost: noise in the logarithm raises the mean.
    pub mean_factor: f64,
    pub points: usize,
}

/// Degrees of freedom of the noise, and weight of the prior scale in units of labels.
const DEGREES_OF_FREEDOM: f64 = 4.0;

/// The weights converge in about ten iterations; the rest settles the last digits.
const ITERATIONS: usize = 60;

impl Fit {
    /// Fits by expectation maximisation: with fixed weights the problem is linear; the residuals then give
    /// scale and weights. `None` without points and guess.
    pub fn new(points: &[CostPoint], guess: Option<CostPoint>) -> Option<Self> {
        if points.is_empty() && guess.is_none() {
            return None;
        }
        let (mut weights, mut scale) = (vec![1.0; points.len()], PRIOR_NOISE_SCALE);
        let (mut coefficients, mut covariance) = solve(points, &weights, scale, guess)?;
        for _ in 0..ITERATIONS {
            let squares =
                |(point, weight): (&CostPoint, &f64)| weight * residual(&coefficients, point).powi(2);
            let left_over: f64 = points.iter().zip(&weights).map(squares).sum();
            // A single label always fits and carries no information on the scale.
            let freedom = points.len().saturating_sub(1) as f64;
            scale = ((DEGREES_OF_FREEDOM * PRIOR_NOISE_SCALE * PRIOR_NOISE_SCALE + left_over)
                / (DEGREES_OF_FREEDOM + freedom))
                .sqrt();
            for (weight, point) in weights.iter_mut().zip(points) {
                let away = residual(&coefficients, point) / scale;
                *weight = (DEGREES_OF_FREEDOM + 1.0) / (DEGREES_OF_FREEDOM + away * away);
            }
            (coefficients, covariance) = solve(points, &weights, scale, guess)?;
        }
        let mut fit = Self { coefficients, covariance, scale, mean_factor: 1.0, points: points.len() };
        fit.mean_factor = fit.mean_of_factors(points, &weights);
        Some(fit)
    }

    /// The logarithm of the median cost.
    pub fn at(&self, row: &[f64; 3]) -> f64 {
        self.coefficients.iter().zip(row).map(|(c, x)| c * x).sum()
    }

    /// Variance of [`Self::at`], from the uncertainty of the coefficients.
    pub fn variance(&self, row: &[f64; 3]) -> f64 {
        let term = |i: usize, k: usize| row[i] * self.covariance[i][k] * row[k];
        (0..3).map(|i| (0..3).map(|k| term(i, k)).sum::<f64>()).sum()
    }

    /// Variance of one cost / its squared mean, for normal noise.
    pub fn relative_variance(&self) -> f64 {
        self.scale.powi(2).exp_m1()
    }

    /// Mean of cost / median cost over the labels, with the weights of the fit.
    fn mean_of_factors(&self, points: &[CostPoint], weights: &[f64]) -> f64 {
        let (mut sum, mut weight) =
            (DEGREES_OF_FREEDOM * (0.5 * self.scale.powi(2)).exp(), DEGREES_OF_FREEDOM);
        for (point, w) in points.iter().zip(weights) {
            sum += w * residual(&self.coefficients, point).exp();
            weight += w;
        }
        sum / weight
    }
}

fn residual(coefficients: &[f64; 3], (row, cost): &CostPoint) -> f64 {
    cost - coefficients.iter().zip(row).map(|(c, x)| c * x).sum::<f64>()
}

/// Most probable coefficients and their covariance.
fn solve(
    points: &[CostPoint],
    weights: &[f64],
    scale: f64,
    guess: Option<CostPoint>,
) -> Option<([f64; 3], Matrix3x3)> {
    let (mut precision, mut right) = ([[0.0; 3]; 3], [0.0; 3]);
    for (k, prior) in EXPONENT_PRIORS.iter().enumerate() {
        precision[k + 1][k + 1] = prior.sd.powi(-2);
        right[k + 1] = prior.mean * prior.sd.powi(-2);
    }
    let measured = points.iter().zip(weights).map(|(point, weight)| (point, weight / (scale * scale)));
    let guessed = guess.iter().map(|point| (point, GUESS_SIGMA.powi(-2)));
    for ((row, cost), weight) in measured.chain(guessed) {
        for i in 0..3 {
            (0..3).for_each(|k| precision[i][k] += weight * row[i] * row[k]);
            right[i] += weight * row[i] * cost;
        }
    }
    let covariance = inverse(&precision)?;
    let product = |row: &[f64; 3]| row.iter().zip(&right).map(|(a, b)| a * b).sum();
    Some((covariance.each_ref().map(product), covariance))
}

/// Inverse of a symmetric matrix by cofactors.
fn inverse(m: &Matrix3x3) -> Option<Matrix3x3> {
    let cofactor = |i: usize, k: usize| {
        let ([a, b], [c, d]) = ([(i + 1) % 3, (i + 2) % 3], [(k + 1) % 3, (k + 2) % 3]);
        m[a][c] * m[b][d] - m[a][d] * m[b][c]
    };
    let determinant: f64 = (0..3).map(|k| m[0][k] * cofactor(0, k)).sum();
    let inverse = std::array::from_fn(|i| std::array::from_fn(|k| cofactor(k, i) / determinant));
    (determinant.is_finite() && determinant > 0.0).then_some(inverse)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_inverse_by_hand() {
        // Determinant 2 (2 · 3 − 1) − 1 (1 · 3) = 7.
        let inverse = inverse(&[[2.0, 1.0, 0.0], [1.0, 2.0, 1.0], [0.0, 1.0, 3.0]]).unwrap();
        let expected =
            [[5.0, -3.0, 1.0], [-3.0, 6.0, -2.0], [1.0, -2.0, 3.0]].map(|row| row.map(|x| x / 7.0));
        assert_eq!(inverse, expected);
        assert_eq!(super::inverse(&[[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), None);
    }

    /// A line through two points; the priors determine the slopes that the points do not.
    #[test]
    fn without_noise_the_line_goes_through_the_points() {
        let points: Vec<_> = [-1.0, 0.0, 1.0].map(|x| ([1.0, x, 0.0], 5.0 + 1.5 * x)).to_vec();
        let fit = Fit::new(&points, None).unwrap();
        // Scale of three points without noise: σ² = 4 · 0.26² / 6. The prior of the slope, 2 ± 0.75, competes
        // with two points at distance 1 of weight 5/4: (2.5 · 1.5 / σ² + 2 / 0.75²) / (2.5 / σ² + 1 / 0.75²).
        let (data, prior) = (2.5 / (4.0 * PRIOR_NOISE_SCALE * PRIOR_NOISE_SCALE / 6.0), 0.75_f64.powi(-2));
        let expected = (1.5 * data + 2.0 * prior) / (data + prior);
        assert!((fit.coefficients[0] - 5.0).abs() < 1e-9);
        assert!((fit.coefficients[1] - expected).abs() < 0.01, "{} {expected}", fit.coefficients[1]);
        assert!((fit.coefficients[2] - 1.0).abs() < 1e-12);
    }
}
