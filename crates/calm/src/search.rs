//! The search for the update: trials of α, the stop rule, and the inflation after it.

use serde::{Deserialize, Serialize};

use crate::alpha_scan::AlphaScan;
use crate::grade::maximum;
use crate::mixture::{ChangedComponent, Mixture};
use crate::rules::{CovarianceUpdateKind, UpdateRule, UpdateSettings, atom_limit, count_above};
use crate::update::{Batch, CovarianceUpdate, UpdateError};

/// Inflation multiplies a scatter by this at most, each round.
pub const INFLATION_LIMIT: f64 = 4.0;
/// Rounds of inflation.
pub const INFLATION_ROUNDS: usize = 3;
/// Inflation aims at this share of the target.
pub const INFLATION_AIM: f64 = 0.95;

/// A fast trial with a grade closer than this (relative) to a threshold is decided by the direct inverse.
const UNDECIDED: f64 = 1e-5;

/// The grades of the collected structure under one α.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Trial {
    /// Weight of the batch.
    pub alpha: f64,
    /// Largest grade.
    pub gamma_max: f64,
    /// Number of atoms above the rule's threshold (of the maximum rule: its target).
    pub above: usize,
}

/// What ended an update.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UpdateEnd {
    /// A trial brought γ_max below the target.
    MaximumBelowTarget,
    /// No trial did, the inflation of the last one did.
    Inflated,
    /// Neither did; the bounded inflation is used up and γ_max still is not below the target.
    InflationExhausted,
    /// A trial left few enough atoms above the threshold.
    CountBelowLimit,
    /// None did; a trial brought γ_max below the target.
    FallbackMaximum,
    /// Neither; the last α was taken.
    FallbackLast,
}

/// A found update: what the log needs to know, and the components to put into the mixture.
#[derive(Debug, Clone, PartialEq)]
pub struct UpdateOutcome {
    /// Version of the mixture that the trials started from.
    pub base_version: u64,
    /// Convex or additive.
    pub combination: CovarianceUpdateKind,
    /// The chosen α.
    pub alpha: f64,
    /// The trials in order, up to the one that decided.
    pub trials: Vec<Trial>,
    /// What ended the search.
    pub end: UpdateEnd,
    /// Factors of the scatter in each round of inflation; mostly none.
    pub inflations: Vec<f64>,
    /// The touched components after the update, for [`Mixture::with_changes`].
    pub changed: Vec<ChangedComponent>,
    /// γ of the structure's atoms before, `[atoms]`.
    pub gamma_before: Vec<f64>,
    /// γ of the structure's atoms after, with the real inverses, `[atoms]`.
    pub gamma_after: Vec<f64>,
}

/// Finds the update of a mixture for a collected structure; every trial starts from the covariance before it.
///
/// `elements` holds an element index for each atom, `features` is `[atoms × D]`. Trials use [`AlphaScan`] where it
/// is accurate; the decision is always the one that direct inverses would give.
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
    let (trials, alpha, mut end) = choose(&batch, settings)?;
    let mut changed = batch.updated(settings.combination.with_alpha(alpha))?;
    let mut inflations = Vec::new();
    if let (UpdateEnd::InflationExhausted, UpdateRule::MaximumGrade { target }) = (end, settings.stop) {
        (changed, inflations) = inflate(&batch, changed, target.get())?;
        if maximum(&batch.gamma_under(&changed)) < target.get() {
            end = UpdateEnd::Inflated;
        }
    }
    Ok(UpdateOutcome {
        base_version: mixture.version(),
        combination: settings.combination,
        alpha,
        trials,
        end,
        inflations,
        gamma_before: batch.gamma().to_vec(),
        gamma_after: batch.gamma_under(&changed),
        changed,
    })
}

/// The bounded inflation: at most three rounds of scatter ← min(4, (γ_max / 0.95 target)²) · scatter, on every
/// component that the structure touches, while γ_max ≥ target.
///
/// `changed` are the components after the last trial. Gives the inflated ones and the factors.
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
        let factor = (gamma_max / (INFLATION_AIM * target)).powi(2).min(INFLATION_LIMIT);
        changed = batch.inflated(&changed, factor)?;
        factors.push(factor);
    }
    Ok((changed, factors))
}

/// Tries α in order until the rule is satisfied. Without success the maximum rule says `InflationExhausted`.
fn choose(batch: &Batch, settings: &UpdateSettings) -> Result<(Vec<Trial>, f64, UpdateEnd), UpdateError> {
    let atoms = batch.gamma().len();
    let (threshold, limit, target) = match settings.stop {
        UpdateRule::MaximumGrade { target } => (target.get(), None, target.get()),
        UpdateRule::AtomCount { threshold, fraction, least, target } => {
            (threshold.get(), Some(atom_limit(atoms, fraction, least)), target.get())
        }
    };
    let ladder = AlphaScan::new(batch, settings.combination);
    let mut trials = Vec::new();
    for alpha in settings.alphas() {
        let gamma =
            trial(batch, &ladder, settings.combination.with_alpha(alpha), alpha, [threshold, target])?;
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

/// γ of the batch under one α: from the ladder, unless that is inaccurate or a grade lies too near a threshold.
fn trial(
    batch: &Batch,
    ladder: &AlphaScan<'_>,
    update: CovarianceUpdate,
    alpha: f64,
    thresholds: [f64; 2],
) -> Result<Vec<f64>, UpdateError> {
    let near = |grade: f64| thresholds.iter().any(|limit| (grade - limit).abs() <= UNDECIDED * limit);
    match ladder.gamma(alpha) {
        Some(gamma) if !gamma.iter().any(|&grade| near(grade)) => Ok(gamma),
        _ => Ok(batch.gamma_under(&batch.updated(update)?)),
    }
}
