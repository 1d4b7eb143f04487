//! Detects a live mixture that forgets the original training data.
//!
//! Convex updates shrink the covariance in directions that recent structures do not visit, so that the training
//! data drift towards γ > 1. The measure is the distribution of their grades.

use serde::{Deserialize, Serialize};

use crate::component::Component;
use crate::rules::{Fraction, Positive};

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

/// How much of an element's training data the live mixture still covers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ElementForgetting {
    /// Chemical symbol.
    pub element: String,
    /// Mean σ² of its training atoms relative to that at the start, see [`mean_square_growth`].
    pub mean_square_growth: f64,
    /// Share of its sampled training atoms with γ > 1; `None` without a sample.
    pub share_above_one: Option<f64>,
    /// Its changed components.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub components: Vec<ComponentForgetting>,
}

/// The same of one component.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ComponentForgetting {
    /// Slot.
    pub component: usize,
    /// Mean σ² of its training atoms relative to that at the start.
    pub mean_square_growth: f64,
}

/// Limits above which the mixture has forgotten too much of its training data.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ForgettingAlarm {
    /// Share of the sampled training atoms with γ > 1, of all atoms and of each element.
    pub share_above_one: Fraction,
    /// Growth of the mean σ² of an element's training atoms. Applies to elements without sampled atoms.
    pub mean_square_growth: Positive,
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

/// By which factor the mean σ² of a component's own training atoms has grown since the start:
/// tr(C⁻¹ C₀) / tr(C₀⁻¹ C₀), with the regularised inverses of both and the covariance C₀ of the training atoms about the
/// centroid. `None` for components without statistics.
pub fn mean_square_growth(before: &Component, now: &Component) -> Option<f64> {
    let covariance = before.statistics()?.covariance();
    // Both are symmetric.
    let trace = |inverse: &[f64]| inverse.iter().zip(&covariance).map(|(a, b)| a * b).sum::<f64>();
    let growth = trace(now.inverse()) / trace(before.inverse());
    growth.is_finite().then_some(growth)
}

impl ElementForgetting {
    /// The component whose training atoms have moved away most.
    pub fn worst_component(&self) -> Option<ComponentForgetting> {
        let by_growth = |a: &&ComponentForgetting, b: &&ComponentForgetting| {
            a.mean_square_growth.total_cmp(&b.mean_square_growth)
        };
        self.components.iter().max_by(by_growth).copied()
    }
}

impl Default for ForgettingAlarm {
    /// 20 %, well above the 2 to 9 % of fresh mixtures; and a mean σ² four times as large, which is σ twice as large.
    fn default() -> Self {
        Self { share_above_one: Fraction::FIFTH, mean_square_growth: Positive(4.0) }
    }
}

impl ForgettingAlarm {
    /// How near the alarm is for all sampled training atoms: it is raised above 1.
    ///
    /// If the original mixture already exceeds the limit, the live one must be worse.
    pub fn level_of_share(&self, original: GradeDistribution, live: GradeDistribution) -> f64 {
        if live.share_above_one > original.share_above_one {
            live.share_above_one / self.share_above_one.get()
        } else {
            0.0
        }
    }

    /// The same for an element; `original` is the share of its atoms with γ > 1 under the original mixture. A few of an
    /// element's environments may be rare from the start, so the share must also have grown by half the limit.
    pub fn level_of(&self, element: &ElementForgetting, original: Option<f64>) -> f64 {
        let limit = self.share_above_one.get();
        match element.share_above_one.zip(original) {
            Some((share, original)) if share - original > 0.5 * limit => share / limit,
            Some(_) => 0.0,
            None => element.mean_square_growth / self.mean_square_growth.get(),
        }
    }
}

fn quantile(sorted: &[f64], share: f64) -> f64 {
    let position = share * sorted.len().saturating_sub(1) as f64;
    let value = |index: f64| sorted.get(index as usize).copied().unwrap_or_default();
    let (below, above) = (value(position.floor()), value(position.ceil()));
    below + (above - below) * position.fract()
}
