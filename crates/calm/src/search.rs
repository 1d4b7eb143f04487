//! The search for the update: trials of α, the stop rule, and the inflation that may follow.

use serde::{Deserialize, Serialize};

use crate::alpha_scan::AlphaScan;
use crate::grade::maximum;
use crate::mixture::{ChangedComponent, Mixture};
use crate::rules::{CovarianceUpdateKind, UpdateGoal, UpdateSettings, count_above};
use crate::update::{Batch, CovarianceUpdate, UpdateError};

/// Maximum factor of a scatter in one round of inflation.
const INFLATION_LIMIT: f64 = 4.0;
/// Maximum number of rounds of inflation.
pub const INFLATION_ROUNDS: usize = 3;
/// Inflation aims at this fraction of the target.
const INFLATION_AIM: f64 = 0.95;

/// Where a grade of a fast trial is relatively closer to a threshold than this, the direct inverse decides.
const DECISION_MARGIN: f64 = 1e-5;

/// The grades of the collected structure for one α.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Trial {
    /// Weight of the batch.
    pub alpha: f64,
    /// Largest grade.
    pub gamma_max: f64,
    /// Number of atoms above the threshold of the [`UpdateGoal`].
    pub above: usize,
}

/// How an update ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UpdateEnd {
    /// A trial brought γ_max below the target.
    MaximumBelowTarget,
    /// No trial did, but the inflation of the last one did.
    Inflated,
    /// Neither did: after the bounded inflation γ_max is still not below the target.
    InflationExhausted,
    /// A trial left few enough atoms above the threshold.
    CountBelowLimit,
    /// No trial did, but one brought γ_max below the target.
    FallbackMaximum,
    /// Neither: the last α was used.
    FallbackLast,
}

/// A completed update: its record for the log, and the components that change.
#[derive(Debug, Clone, PartialEq)]
pub struct UpdateOutcome {
    /// Version of the mixture that the trials started from.
    pub base_version: u64,
    /// Convex or additive.
    pub combination: CovarianceUpdateKind,
    /// The chosen α.
    pub alpha: f64,
    /// The trials in order, up to the decisive one.
    pub trials: Vec<Trial>,
    /// How the search ended.
    pub end: UpdateEnd,
    /// Factor of the scatter in each round of inflation; usually empty.
    pub inflations: Vec<f64>,
    /// The changed components, for [`Mixture::with_changes`].
    pub changed: Vec<ChangedComponent>,
    /// γ of the structure's atoms before the update, `[atoms]`.
    pub gamma_before: Vec<f64>,
    /// γ of the structure's atoms after the update, from the actual inverses, `[atoms]`.
    pub gamma_after: Vec<f64>,
}

/// Finds the update of a mixture for a collected structure. Every trial starts from the covariance before the
/// update.
///
/// `elements` has the element index of each atom, `features` is `[atoms × D]`. Trials use [`AlphaScan`] where
/// it is accurate; the result always equals that of direct inverses.
///
/// # Errors
/// Those of [`Batch::new`] and [`Batch::updated`].
pub fn update(
    mixture: &Mixture,
    elements: &[usize],
    features: &[f64],
    settings: &UpdateSettings,
) -> Result<UpdateOutcome, UpdateError> {
    let batch = Batch::new(mixture, elements, features)?;
    let goal = settings.stop.goal(batch.gamma().len());
    let (trials, alpha, mut end) = choose(&batch, settings, goal)?;
    let mut changed = batch.updated(settings.covariance_update.with_alpha(alpha))?;
    let mut inflations = Vec::new();
    if end == UpdateEnd::InflationExhausted {
        (changed, inflations) = inflate(&batch, changed, goal.target)?;
        if maximum(&batch.gamma_under(&changed)) < goal.target {
            end = UpdateEnd::Inflated;
        }
    }
    Ok(UpdateOutcome {
        base_version: mixture.version(),
        combination: settings.covariance_update,
        alpha,
        trials,
        end,
        inflations,
        gamma_before: batch.gamma().to_vec(),
        gamma_after: batch.gamma_under(&changed),
        changed,
    })
}

/// The bounded inflation: at most three rounds of scatter ← [`inflation_factor`] · scatter on every component that the structure
/// touches, while γ_max ≥ target.
///
/// `changed` are the components after the last trial. Returns the inflated components and the factors. It is public
/// because tests compare it alone with the reference.
///
/// # Errors
/// Those of [`Batch::inflated`].
pub fn inflate(
    batch: &Batch,
    mut changed: Vec<ChangedComponent>,
    target: f64,
) -> Result<(Vec<ChangedComponent>, Vec<f64>), UpdateError> {
    let mut factors = Vec::new();
    for _ in 0..INFLATION_ROUNDS {
        let gamma_max = maximum(&batch.gamma_under(&changed));
        if gamma_max < target {
            break;
        }
        let factor = inflation_factor(gamma_max, target);
        changed = batch.inflated(&changed, factor)?;
        factors.push(factor);
    }
    Ok((changed, factors))
}

/// Factor of the scatter in one round of inflation, min(4, (γ_max / 0.95 target)²).
pub(crate) fn inflation_factor(gamma_max: f64, target: f64) -> f64 {
    (gamma_max / (INFLATION_AIM * target)).powi(2).min(INFLATION_LIMIT)
}

/// Tries α in order until the goal is met. If none meets it, a goal without a limit gives `InflationExhausted`.
fn choose(
    batch: &Batch,
    settings: &UpdateSettings,
    goal: UpdateGoal,
) -> Result<(Vec<Trial>, f64, UpdateEnd), UpdateError> {
    let UpdateGoal { threshold, limit, target } = goal;
    let scan = AlphaScan::new(batch, settings.covariance_update);
    let mut trials = Vec::new();
    for alpha in settings.alphas() {
        let gamma =
            trial(batch, &scan, settings.covariance_update.with_alpha(alpha), alpha, [threshold, target])?;
        let trial = Trial { alpha, gamma_max: maximum(&gamma), above: count_above(&gamma, threshold) };
        trials.push(trial);
        match limit {
            None if trial.gamma_max < target => return Ok((trials, alpha, UpdateEnd::MaximumBelowTarget)),
            Some(limit) if trial.above < limit => return Ok((trials, alpha, UpdateEnd::CountBelowLimit)),
            _ => {}
        }
    }
    let last = trials.last().map_or(1.0, |trial| trial.alpha);
    if limit.is_none() {
        return Ok((trials, last, UpdateEnd::InflationExhausted));
    }
    match trials.iter().find(|trial| trial.gamma_max < target).map(|trial| trial.alpha) {
        Some(alpha) => Ok((trials, alpha, UpdateEnd::FallbackMaximum)),
        None => Ok((trials, last, UpdateEnd::FallbackLast)),
    }
}

/// γ of the batch for one α. Uses the scan, unless it is inaccurate or a grade is too close to a threshold.
fn trial(
    batch: &Batch,
    scan: &AlphaScan<'_>,
    update: CovarianceUpdate,
    alpha: f64,
    thresholds: [f64; 2],
) -> Result<Vec<f64>, UpdateError> {
    let near = |grade: f64| thresholds.iter().any(|limit| (grade - limit).abs() <= DECISION_MARGIN * limit);
    match scan.gamma(alpha) {
        Some(gamma) if !gamma.iter().any(|&grade| near(grade)) => Ok(gamma),
        _ => Ok(batch.gamma_under(&batch.updated(update)?)),
    }
}
