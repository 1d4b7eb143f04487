//! Detects a live mixture that forgets the original training data.
//!
//! Convex updates shrink the covariance in directions that recent structures do not visit, so that the training
//! data drift towards γ > 1. There are two measures: the distribution of their grades, if their features are
//! available, and forgetting factors computed from the statistics alone.

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

/// How far one component has forgotten its training data.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ForgettingFactor {
    /// Element index.
    pub element: usize,
    /// Component index.
    pub slot: usize,
    /// √⟨σ²⟩/θ of the component's training atoms under the original mixture.
    pub original: f64,
    /// The same under the live mixture.
    pub live: f64,
    /// Their ratio: 1 is unchanged, above 1 means forgetting on average.
    pub factor: f64,
    /// The largest factor by which σ has grown along any direction, which the average hides.
    pub worst_direction: f64,
}

/// Mixtures that cannot be compared.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ForgettingError {
    /// The original has no statistics.
    #[error(
        "component {slot} of element {element} of the original mixture has no scatter; load gmm_artifacts.npz"
    )]
    NoStatistics {
        /// Element index.
        element: usize,
        /// Component index.
        slot: usize,
    },
    /// A covariance whose eigenvalues do not converge.
    #[error("component {slot} of element {element}: {source}")]
    Linear {
        /// Element index.
        element: usize,
        /// Component index.
        slot: usize,
        /// What failed.
        source: LinearError,
    },
    /// The mixtures have different components.
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

/// The forgetting factor of every component that has training data, computed without their features.
///
/// The second moment of the training features about the centroid is the original covariance C = scatter/count.
/// The mean of σ² over them is therefore exactly ⟨σ²⟩ = tr(S C) for any distribution, with the original S or
/// the live one, and the factor is √(tr(S_live C) / tr(S_original C)). The factor of the worst direction is the
/// square root of the largest eigenvalue of (C + εI)^½ S_live (C + εI)^½; an update with weight α multiplies it
/// by at most (1 − α)^−½.
///
/// Neither measures the tail of γ. The mean is more sensitive to rare outlying atoms than the median, and it
/// falls when directions that the batches visit grow although others are forgotten. The worst direction may
/// matter little to any atom. Both assume that atoms stay assigned to the same centroids, which are fixed. For
/// a weighted artifact the mean is the weighted one.
///
/// # Errors
/// Mixtures that are not versions of the same artifact, an original without statistics, eigenvalues that do not
/// converge.
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

/// √λ_max of (C + εI)^½ S (C + εI)^½, from the eigenvectors of C.
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
