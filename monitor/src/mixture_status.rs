//! State of the mixture's components, compared with those at the start of the campaign.

use std::sync::Arc;

use calm::drift::{self, Drift};
use calm::forgetting::mean_square_growth;
use calm::{Component, LinearError, Mixture, MixtureError};
use serde::Serialize;
use store::NewestMixture;

/// The mixture at the start of a campaign.
#[derive(Clone, Debug)]
pub struct InitialMixture {
    /// Chemical symbols by element index.
    pub symbols: Vec<String>,
    /// The mixture of the artifact.
    pub mixture: Mixture,
}

/// The mixture in force.
#[derive(Debug, Serialize)]
pub struct MixtureStatus {
    /// Its version.
    version: u64,
    /// Number of the newest decision.
    decision: i64,
    /// Dimension of the features.
    feature_dimension: usize,
    /// By element and slot.
    components: Vec<ComponentStatus>,
}

/// A stored mixture that cannot be compared.
#[derive(Debug, thiserror::Error)]
pub enum MixtureStatusError {
    /// Damaged components, or those of another mixture.
    #[error("the mixture: {0}")]
    Mixture(#[from] MixtureError),
    /// A covariance that is not positive definite.
    #[error("the mixture: {0}")]
    Covariance(#[from] LinearError),
}

/// One component of the mixture.
#[derive(Debug, Serialize)]
struct ComponentStatus {
    element: String,
    component: usize,
    /// Calibrated threshold θ of σ.
    threshold: f64,
    /// Environments at the start and now. `None` if the campaign started from an export alone.
    environments_before: Option<f64>,
    environments: Option<f64>,
    /// Current sum of their weights.
    weighted: Option<f64>,
    /// Current condition number of the covariance.
    condition_number: Option<f64>,
    /// Whether an update has ever changed the component.
    moved: bool,
    /// Factors on the width in the directions of the largest growth and the largest shrinkage.
    grown: Option<f64>,
    shrunk: Option<f64>,
    /// Distance of the covariances, √Σ ln²λ.
    distance: Option<f64>,
    /// Mean σ² of the component's training atoms, relative to the start. `None` without statistics.
    mean_square_growth: Option<f64>,
}

/// Compares each component with its start.
///
/// # Errors
/// Fails on a damaged database, or if the mixture did not grow from `original`.
pub fn mixture_status(
    original: &InitialMixture,
    newest: &NewestMixture,
) -> Result<MixtureStatus, MixtureStatusError> {
    let stored = newest.components.iter();
    let stored = stored.map(|record| (record.element as usize, record.slot as usize, &record.bytes[..]));
    let now = original.mixture.restored(newest.version, stored)?;
    let component = |(element, slot, now): (usize, usize, &Arc<Component>)| {
        let symbol = original.symbols.get(element).cloned().unwrap_or_default();
        ComponentStatus::compare(symbol, slot, original.mixture.component(element, slot), now)
    };
    let components = now.iter().map(component).collect::<Result<_, _>>()?;
    let NewestMixture { version, decision, .. } = *newest;
    Ok(MixtureStatus { version, decision, feature_dimension: now.dimension(), components })
}

impl ComponentStatus {
    fn compare(
        element: String,
        component: usize,
        before: Option<&Arc<Component>>,
        now: &Arc<Component>,
    ) -> Result<Self, LinearError> {
        let moved = !before.is_some_and(|before| Arc::ptr_eq(before, now));
        let drift = match before {
            Some(before) if moved => drift::drift(before, now)?,
            _ => Some(Drift { grown: 1.0, shrunk: 1.0, distance: 0.0 }),
        };
        let count = |component: &Component| component.statistics().map(|statistics| statistics.count);
        Ok(Self {
            element,
            component,
            threshold: now.threshold(),
            environments_before: before.and_then(|before| count(before)),
            environments: count(now),
            weighted: now.statistics().map(|statistics| statistics.effective_count),
            condition_number: drift::condition_number(now)?,
            moved,
            grown: drift.map(|drift| drift.grown),
            shrunk: drift.map(|drift| drift.shrunk),
            distance: drift.map(|drift| drift.distance),
            mean_square_growth: before.and_then(|before| mean_square_growth(before, now)),
        })
    }
}
