//! Detects a live mixture that forgets the original training data.
//!
//! Convex updates shrink the covariance in directions that recent structures do not visit, so that the training
//! data drift towards γ > 1. The measure is the distribution of their grades.

use serde::{Deserialize, Serialize};

use crate::grade::{GradeError, Grades};
use crate::mixture::Mixture;
use crate::rules::Fraction;

/// The distribution of γ over atoms.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GradeDistribution {
    /// Number of atoms.
    pub atoms: usize,
    /// Median.
    pub median: f64,
    /// 95 % quantile.
    pub percentile_95: f64,
    /// Maximum.
    pub maximum: f64,
    /// Fraction of the atoms with γ > 1; 2 to 5 % of the training data of foundation models under a fresh
    /// mixture (paper).
    pub share_above_one: f64,
}

/// When the drift of the training data's grades raises an alarm.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ForgettingAlarm {
    /// Raises the alarm when more than this fraction of the training atoms has γ > 1.
    pub share_above_one: Fraction,
}

impl GradeDistribution {
    /// The distribution of these grades; all zero without grades.
    ///
    /// Quantiles are interpolated linearly between order statistics.
    pub fn from_grades(gamma: &[f64]) -> Self {
        let mut sorted = gamma.to_vec();
        sorted.sort_by(f64::total_cmp);
        let above = sorted.iter().filter(|&&grade| grade > 1.0).count();
        Self {
            atoms: gamma.len(),
            median: quantile(&sorted, 0.5),
            percentile_95: quantile(&sorted, 0.95),
            maximum: sorted.last().copied().unwrap_or_default(),
            share_above_one: above as f64 / gamma.len().max(1) as f64,
        }
    }
}

/// The distribution of γ of training atoms under a mixture. Compare the live mixture's with the original's.
///
/// `elements` has the element index of each atom of all frames, `features` is `[atoms × D]`.
///
/// # Errors
/// Those of [`Grades::evaluate`].
pub fn grade_distribution(
    mixture: &Mixture,
    elements: &[usize],
    features: &[f64],
) -> Result<GradeDistribution, GradeError> {
    let mut grades = Grades::default();
    grades.evaluate(mixture, elements, features, None)?;
    Ok(GradeDistribution::from_grades(&grades.gamma))
}

impl Default for ForgettingAlarm {
    /// 20 %, well above the 2 to 9 % of fresh mixtures.
    fn default() -> Self {
        Self { share_above_one: Fraction::FIFTH }
    }
}

impl ForgettingAlarm {
    /// Whether the live distribution of the training data's grades raises the alarm.
    ///
    /// If the original mixture already exceeds the limit, the alarm requires that the live one is worse.
    pub fn is_raised(&self, original: &GradeDistribution, live: &GradeDistribution) -> bool {
        live.share_above_one > self.share_above_one.get() && live.share_above_one > original.share_above_one
    }
}

fn quantile(sorted: &[f64], share: f64) -> f64 {
    let position = share * sorted.len().saturating_sub(1) as f64;
    let value = |index: f64| sorted.get(index as usize).copied().unwrap_or_default();
    let (below, above) = (value(position.floor()), value(position.ceil()));
    below + (above - below) * position.fract()
}
