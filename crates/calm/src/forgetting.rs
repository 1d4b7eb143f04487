//! Whether the live mixture still knows the original training data.
//!
//! Convex updates shrink the covariance in directions that recent structures do not visit, so that the training data
//! themselves drift towards γ > 1. Two measures: the distribution of their grades, if their features are at hand,
//! and forgetting factors from the statistics alone.

use std::sync::Arc;

use faer::Mat;
use serde::{Deserialize, Serialize};

use crate::component::Component;
use crate::grade::{GradeError, Grades, THRESHOLD_FLOOR};
use crate::linear::{Eigen, LinearError, dot, eigen, product, regularised, view};
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
    /// Largest.
    pub maximum: f64,
    /// Share of the atoms with γ > 1; 2 to 5 % of the training data of foundation models under a fresh mixture (paper).
    pub share_above_one: f64,
}

/// When the drift of the training data's grades is an alarm.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ForgettingAlarm {
    /// Alarm when more than this share of the training atoms has γ > 1.
    pub share_above_one: Fraction,
}

/// How far one component has forgotten its training data.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ForgettingFactor {
    /// Element index.
    pub element: usize,
    /// Component index.
    pub slot: usize,
    /// √⟨σ²⟩/θ of the component's training atoms under the original mixture.
    pub original: f64,
    /// The same under the live one.
    pub live: f64,
    /// Their ratio: 1 is unchanged, above 1 forgets on the average.
    pub factor: f64,
    /// The largest factor by which σ has grown along any one direction: what the average hides.
    pub worst_direction: f64,
}

/// Mixtures that cannot be compared.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ForgettingError {
    /// The original has no scatter.
    #[error(
        "component {slot} of element {element} of the original mixture has no scatter; load gmm_artifacts.npz"
    )]
    NoStatistics {
        /// Element index.
        element: usize,
        /// Component index.
        slot: usize,
    },
    /// A covariance without eigenvalues.
    #[error("component {slot} of element {element}: {source}")]
    Linear {
        /// Element index.
        element: usize,
        /// Component index.
        slot: usize,
        /// What failed.
        source: LinearError,
    },
    /// They do not have the same components.
    #[error(
        "the live mixture has no component {slot} of element {element} with the original's centroid and threshold"
    )]
    NotTheSame {
        /// Element index.
        element: usize,
        /// Component index.
        slot: usize,
    },
}

impl GradeDistribution {
    /// The distribution of some grades; all zero for none.
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

/// The distribution of γ of training atoms under a mixture; compare the live mixture's with the original's.
///
/// `elements` holds an element index for each atom of all frames, `features` is `[atoms × D]`.
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
    /// 20 %: well above the 2 to 9 % that fresh mixtures leave outside.
    fn default() -> Self {
        Self { share_above_one: Fraction::FIFTH }
    }
}

impl ForgettingAlarm {
    /// Whether the live distribution of the training data's grades calls for an alarm.
    ///
    /// A mixture that left more outside from the start alarms only when it has become worse.
    pub fn is_raised(&self, original: &GradeDistribution, live: &GradeDistribution) -> bool {
        live.share_above_one > self.share_above_one.get() && live.share_above_one > original.share_above_one
    }
}

/// The forgetting factors of every component that has training data, without their features.
///
/// The second moment of the training features about the centroid is the original covariance C = scatter/count, so
/// the mean of σ² over them is ⟨σ²⟩ = tr(S C), exactly, whatever their distribution, with the original S or the live
/// one; the factor is √(tr(S_live C) / tr(S_original C)). The factor of the worst direction is the square root of the
/// largest eigenvalue of (C + εI)^½ S_live (C + εI)^½: an update with weight α multiplies it by at most (1 − α)^−½.
///
/// Neither is a statement on the tail of γ. The mean follows rare far atoms more than the median does, and falls when
/// directions that the batches do visit grow, although others are forgotten; the worst direction may be one that
/// matters little to any atom. Atoms must still be assigned to the same centroids, which are fixed. For a weighted
/// artifact the mean is the weighted one.
///
/// # Errors
/// Mixtures that are not versions of the same artifact, an original without statistics, failing eigenvalues.
pub fn forgetting_factors(
    original: &Mixture,
    live: &Mixture,
) -> Result<Vec<ForgettingFactor>, ForgettingError> {
    let mut out = Vec::new();
    for (element, slot, component) in original.iter() {
        let statistics = component.statistics().ok_or(ForgettingError::NoStatistics { element, slot })?;
        if statistics.effective_count <= 0.0 {
            continue;
        }
        let same = |now: &&Arc<Component>| {
            now.centroid() == component.centroid() && now.threshold() == component.threshold()
        };
        let now = live.component(element, slot).filter(same);
        let now = now.ok_or(ForgettingError::NotTheSame { element, slot })?;
        let covariance = statistics.covariance();
        let root_mean_square = |inverse: &[f64]| {
            dot(inverse, &covariance).max(0.0).sqrt() / component.threshold().max(THRESHOLD_FLOOR)
        };
        let (original, live) = (root_mean_square(component.inverse()), root_mean_square(now.inverse()));
        let (factor, worst_direction) = if Arc::ptr_eq(component, now) {
            (1.0, 1.0)
        } else {
            let worst = worst_direction(&covariance, now.inverse(), component.dimension());
            (live / original, worst.map_err(|source| ForgettingError::Linear { element, slot, source })?)
        };
        out.push(ForgettingFactor { element, slot, original, live, factor, worst_direction });
    }
    Ok(out)
}

/// √λ_max of (C + εI)^½ S (C + εI)^½, by way of the eigenvectors of C.
fn worst_direction(covariance: &[f64], inverse: &[f64], dimension: usize) -> Result<f64, LinearError> {
    let regularised = regularised(covariance, dimension);
    let Eigen { values, vectors } = eigen(view(&regularised, dimension, dimension))?;
    let roots: Vec<f64> = values.iter().map(|value| value.max(0.0).sqrt()).collect();
    let root = Mat::from_fn(dimension, dimension, |row, column| vectors[(row, column)] * roots[column]);
    let half = product(view(inverse, dimension, dimension), root.as_ref());
    let largest = eigen(product(root.transpose(), half.as_ref()).as_ref())?.values.last().copied();
    Ok(largest.unwrap_or_default().max(0.0).sqrt())
}

fn quantile(sorted: &[f64], share: f64) -> f64 {
    let position = share * sorted.len().saturating_sub(1) as f64;
    let value = |index: f64| sorted.get(index as usize).copied().unwrap_or_default();
    let (below, above) = (value(position.floor()), value(position.ceil()));
    below + (above - below) * position.fract()
}
