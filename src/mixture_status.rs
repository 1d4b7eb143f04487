//! State of the mixture's components, compared with those at the start of the campaign.

use std::path::Path;
use std::sync::Arc;

use calm::drift::{self, Drift};
use calm::{Artifact, Component, LinearError, Mixture};
use serde::Serialize;
use serde_json::Value;
use store::{NewestMixture, Store};

use crate::exit_status::Failure;
use crate::process_config::verify_hash;

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
}

impl InitialMixture {
    /// Reads the artifact from the path that the campaign last used.
    ///
    /// # Errors
    /// Fails if the file is missing or has another content.
    pub async fn read(store: &Store) -> Result<Self, Failure> {
        let campaign = store.campaign().await?;
        let resolved: Value = serde_json::from_str(&campaign.resolved_configuration)
            .map_err(|error| Failure::Failed(format!("damaged database: the configuration: {error}")))?;
        let files = store.grade_files().await?;
        let (key, load): (_, fn(&Path) -> _) = match &files["calm.artifact"] {
            Value::String(_) => ("calm.artifact", |path| Artifact::load(path)),
            _ => ("potential.model", |path| Artifact::load_export(path)),
        };
        let path = files[key].as_str().ok_or_else(|| {
            Failure::Input(format!("the store has no path of {key}, with which the campaign began"))
        })?;
        let path = Path::new(path);
        verify_hash(path, resolved["files"][key].as_str().unwrap_or_default())?;
        let Artifact { symbols, mixture, .. } = load(path).map_err(Failure::input)?;
        Ok(Self { symbols, mixture })
    }
}

/// Compares each component with its start.
///
/// # Errors
/// Fails on a damaged database, or if the mixture did not grow from `original`.
pub fn mixture_status(original: &InitialMixture, newest: &NewestMixture) -> Result<MixtureStatus, Failure> {
    let damaged = |error: &dyn ToString| Failure::Failed(format!("the mixture: {}", error.to_string()));
    let now = orchestrator::selector::restored_mixture(&original.mixture, newest.version, &newest.components)
        .map_err(|error| damaged(&error))?;
    let component = |(element, slot, now): (usize, usize, &Arc<Component>)| {
        let symbol = original.symbols.get(element).cloned().unwrap_or_default();
        ComponentStatus::compare(symbol, slot, original.mixture.component(element, slot), now)
    };
    let components = now.iter().map(component).collect::<Result<_, _>>().map_err(|error| damaged(&error))?;
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
        })
    }
}
