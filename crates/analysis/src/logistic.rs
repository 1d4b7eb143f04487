//! Logistic regression with a ridge penalty.

/// Newton steps; about ten are needed.
const MAX_STEPS: usize = 100;
/// Halvings of a step that does not lower the loss.
const MAX_HALVINGS: usize = 40;
/// Converged when no coefficient changes by more.
const TOLERANCE: f64 = 1e-10;

/// The coefficients b, w₁, w₂ … of the probability p of an event as a function of predictors **x**, each per unit of its predictor,
///
/// ln(p / (1 − p)) = b + Σₖ wₖ xₖ.
///
/// b and **w** minimise −Σᵢ ln P(yᵢ | **x**ᵢ) + ½ λ Σₖ (sₖ wₖ)², where sₖ is the standard deviation of xₖ over the data, so that the
/// penalty does not depend on units; b is not penalised. The minimum is unique and finite for λ > 0 if both outcomes
/// occur, also where a predictor separates them (Hastie, Tibshirani and Friedman, *The Elements of Statistical Learning*,
/// 2nd ed., sections 4.4.1 and 18.4).
///
/// `rows` are the predictors **x**ᵢ, `outcomes` whether the event happened (yᵢ), `penalty` is λ. A predictor without spread has the
/// weight 0. `None` unless both outcomes occur, all rows are equally long, all numbers are finite, and λ is above 0.
pub fn logistic_regression(rows: &[Vec<f64>], outcomes: &[bool], penalty: f64) -> Option<Vec<f64>> {
    let columns = rows.first()?.len();
    let is_usable = |row: &Vec<f64>| row.len() == columns && row.iter().all(|x| x.is_finite());
    let happened = outcomes.iter().filter(|outcome| **outcome).count();
    let both = happened > 0 && happened < outcomes.len();
    if rows.len() != outcomes.len()
        || !both
        || !rows.iter().all(is_usable)
        || penalty.is_nan()
        || penalty <= 0.0
    {
        return None;
    }
    let scales: Vec<Scale> =
        (0..columns).map(|k| Scale::from_values(rows.iter().map(|row| row[k]))).collect();
    let standard = |row: &Vec<f64>| {
        let scaled = row.iter().zip(&scales).map(|(x, scale)| scale.apply(*x));
        [1.0].into_iter().chain(scaled).collect::<Vec<f64>>()
    };
    let data = RegressionData { rows: rows.iter().map(standard).collect(), outcomes, penalty };
    let share = happened as f64 / outcomes.len() as f64;
    let mut start = vec![0.0; columns + 1];
    start[0] = (share / (1.0 - share)).ln();
    let mut coefficients = data.minimise(start)?;
    let (intercept, weights) = coefficients.split_first_mut()?;
    for (weight, scale) in weights.iter_mut().zip(&scales) {
        *weight /= scale.deviation;
        *intercept -= *weight * scale.mean;
    }
    Some(coefficients)
}

/// Mean and standard deviation of a predictor.
struct Scale {
    mean: f64,
    deviation: f64,
}

impl Scale {
    fn from_values(values: impl Iterator<Item = f64> + Clone) -> Self {
        let number = values.clone().count() as f64;
        let mean = values.clone().sum::<f64>() / number;
        let deviation = (values.map(|x| (x - mean).powi(2)).sum::<f64>() / number).sqrt();
        // Without spread the column is zero, and so is its weight.
        let has_spread = deviation > 1e-12 * mean.abs().max(1e-300);
        Self { mean, deviation: if has_spread { deviation } else { f64::INFINITY } }
    }

    fn apply(&self, x: f64) -> f64 {
        (x - self.mean) / self.deviation
    }
}

/// Rows (1, scaled predictors …).
struct RegressionData<'a> {
    rows: Vec<Vec<f64>>,
    outcomes: &'a [bool],
    penalty: f64,
}

impl RegressionData<'_> {
    /// Newton's method with halved steps. `None` if the Hessian is singular, which the penalty prevents.
    fn minimise(&self, start: Vec<f64>) -> Option<Vec<f64>> {
        let (mut at, mut loss) = (start, f64::INFINITY);
        for _ in 0..MAX_STEPS {
            loss = loss.min(self.loss(&at));
            let step = self.newton_step(&at)?;
            let mut factor = 1.0;
            let moved = |factor: f64| at.iter().zip(&step).map(|(x, d)| x - factor * d).collect::<Vec<f64>>();
            let mut next = moved(factor);
            let mut halvings = 0;
            while self.loss(&next).total_cmp(&loss).is_gt() && halvings < MAX_HALVINGS {
                factor *= 0.5;
                next = moved(factor);
                halvings += 1;
            }
            if halvings == MAX_HALVINGS {
                return Some(at);
            }
            let change = step.iter().map(|d| (factor * d).abs()).fold(0.0, f64::max);
            at = next;
            if change < TOLERANCE {
                break;
            }
        }
        Some(at)
    }

    fn loss(&self, at: &[f64]) -> f64 {
        let of_row = |(row, happened): (&Vec<f64>, &bool)| {
            let odds = dot(row, at);
            // ln(1 + eᵗ) without overflow.
            let softplus = odds.max(0.0) + (-odds.abs()).exp().ln_1p();
            softplus - if *happened { odds } else { 0.0 }
        };
        let data: f64 = self.rows.iter().zip(self.outcomes).map(of_row).sum();
        data + 0.5 * self.penalty * at[1..].iter().map(|weight| weight * weight).sum::<f64>()
    }

    /// H⁻¹ g.
    fn newton_step(&self, at: &[f64]) -> Option<Vec<f64>> {
        let size = at.len();
        let (mut hessian, mut gradient) = (vec![vec![0.0; size]; size], vec![0.0; size]);
        for (row, happened) in self.rows.iter().zip(self.outcomes) {
            let probability = logistic(dot(row, at));
            let residual = probability - f64::from(u8::from(*happened));
            let weight = probability * (1.0 - probability);
            for (i, x) in row.iter().enumerate() {
                gradient[i] += residual * x;
                hessian[i].iter_mut().zip(&row[..=i]).for_each(|(entry, other)| *entry += weight * x * other);
            }
        }
        for (k, x) in at.iter().enumerate().skip(1) {
            gradient[k] += self.penalty * x;
            hessian[k][k] += self.penalty;
        }
        // Where all probabilities are 0 or 1, nothing curves the loss along the intercept.
        hessian[0][0] += f64::EPSILON * self.rows.len() as f64;
        solve(hessian, gradient)
    }
}

/// Solves H x = g by Cholesky's decomposition; of the symmetric H the lower triangle is given. `None` if H is not positive
/// definite.
fn solve(mut factor: Vec<Vec<f64>>, mut right: Vec<f64>) -> Option<Vec<f64>> {
    let size = right.len();
    for i in 0..size {
        for j in 0..=i {
            let (row, other) = (&factor[i], &factor[j]);
            let left = row[j] - dot(&row[..j], &other[..j]);
            factor[i][j] = if i == j { left.sqrt() } else { left / factor[j][j] };
        }
        if !factor[i][i].is_normal() {
            return None;
        }
        right[i] = (right[i] - dot(&factor[i][..i], &right[..i])) / factor[i][i];
    }
    for i in (0..size).rev() {
        let known: f64 = (i + 1..size).map(|k| factor[k][i] * right[k]).sum();
        right[i] = (right[i] - known) / factor[i][i];
    }
    Some(right)
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// 1 / (1 + e⁻ᵗ).
fn logistic(odds: f64) -> f64 {
    1.0 / (1.0 + (-odds).exp())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn probability(coefficients: &[f64], row: &[f64]) -> f64 {
        logistic(coefficients[0] + dot(&coefficients[1..], row))
    }

    /// 60 rows of three predictors with different units, and outcomes.
    fn example() -> (Vec<Vec<f64>>, Vec<bool>) {
        let row = |i: usize| {
            let x = i as f64;
            vec![(1.7 * x).sin() + 0.01 * x, 1.0 + 0.4 * (0.9 * x).cos(), (i * 7 % 13) as f64 / 13.0]
        };
        let rows: Vec<Vec<f64>> = (0..60).map(row).collect();
        let happened = |(i, row): (usize, &Vec<f64>)| {
            let odds = 1.2 * row[0] - 4.0 * (row[1] - 1.1) + 0.5 * row[2] + 1.5 * (5.3 * i as f64).sin();
            odds > -0.4
        };
        let outcomes = rows.iter().enumerate().map(happened).collect();
        (rows, outcomes)
    }

    /// sklearn.linear_model.LogisticRegression(C=1/penalty, tol=1e-12) of predictors scaled by their numpy.std, in their own units
    /// (scikit-learn 1.9.1).
    #[test]
    fn coefficients_are_those_of_scikit_learn() {
        let (rows, outcomes) = example();
        assert_eq!(outcomes.iter().filter(|happened| **happened).count(), 44);
        for (penalty, intercept, weights, first) in [
            (0.1, 7.188_359_295_9, [1.742_677_223_2, -6.596_556_796_5, 1.603_098_779_6], 0.114_374_074_95),
            (1.0, 5.746_546_826_5, [1.356_611_333_7, -5.153_312_091_6, 1.296_692_357_1], 0.187_233_082_68),
            (10.0, 2.953_740_306_7, [0.584_957_209_5, -2.263_016_937_5, 0.637_621_703_8], 0.446_583_767_89),
        ] {
            let model = logistic_regression(&rows, &outcomes, penalty).unwrap();
            assert!(model.len() == 4 && (model[0] - intercept).abs() < 1e-5, "{model:?}");
            for (found, expected) in model[1..].iter().zip(weights) {
                assert!((found - expected).abs() < 1e-5, "{model:?}");
            }
            assert!((probability(&model, &rows[0]) - first).abs() < 1e-6, "{model:?}");
        }
    }

    #[test]
    fn what_has_no_unique_minimum_is_refused_or_harmless() {
        let rows = vec![vec![0.0], vec![1.0], vec![2.0]];
        assert_eq!(logistic_regression(&rows, &[true; 3], 1.0), None);
        assert_eq!(logistic_regression(&rows, &[true, false, true], 0.0), None);
        assert_eq!(logistic_regression(&[vec![f64::NAN], vec![1.0]], &[true, false], 1.0), None);
        assert_eq!(logistic_regression(&[], &[], 1.0), None);
        // A predictor separates the outcomes: without the penalty its weight would be infinite.
        let separated = logistic_regression(&rows, &[true, true, false], 0.01).unwrap();
        assert!(separated[1] < -1.0 && separated[1].is_finite(), "{separated:?}");
        // A predictor without spread says nothing: the share remains.
        let constant =
            logistic_regression(&[vec![5.0], vec![5.0], vec![5.0]], &[true, true, false], 1.0).unwrap();
        assert_eq!(constant[1..], [0.0]);
        assert!((probability(&constant, &[7.0]) - 2.0 / 3.0).abs() < 1e-9);
    }

    proptest! {
        /// At the minimum the mean probability is the share of events, because the intercept is not penalised; and the model
        /// does not depend on units.
        #[test]
        fn the_mean_probability_is_the_share(
            data in prop::collection::vec((any::<bool>(), -3.0..3.0_f64, 0.5..1.5_f64), 5..60),
            unit in 1e-3..1e3_f64,
            penalty in 0.01..10.0_f64,
        ) {
            let outcomes: Vec<bool> = data.iter().map(|(happened, ..)| *happened).collect();
            let rows: Vec<_> = data.iter().map(|(_, a, b)| vec![*a, *b]).collect();
            let Some(model) = logistic_regression(&rows, &outcomes, penalty) else { return Ok(()) };
            let mean = rows.iter().map(|row| probability(&model, row)).sum::<f64>() / rows.len() as f64;
            let share = outcomes.iter().filter(|happened| **happened).count() as f64 / rows.len() as f64;
            prop_assert!((mean - share).abs() < 1e-6, "{} {}", mean, share);
            let other: Vec<_> = rows.iter().map(|row| vec![unit * row[0] + 7.0, row[1]]).collect();
            let other_model = logistic_regression(&other, &outcomes, penalty).unwrap();
            for (row, other) in rows.iter().zip(&other) {
                prop_assert!((probability(&model, row) - probability(&other_model, other)).abs() < 1e-6);
            }
        }
    }
}
