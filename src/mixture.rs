//! How the components of the mixture in force stand, beside those that the campaign began with.

use std::path::Path;
use std::sync::Arc;

use calm::drift::{self, Drift};
use calm::{Artifact, Component, LinearError, Mixture};
use serde::Serialize;
use serde_json::Value;
use store::{NewestMixture, Store};

use crate::outcome::Failure;
use crate::setup::unchanged;

/// What a campaign began with.
#[derive(Clone, Debug)]
pub struct Original {
    /// Chemical symbols by element index.
    pub symbols: Vec<String>,
    /// The mixture of the artifact.
    pub mixture: Mixture,
}

/// The mixture in force.
#[derive(Debug, Serialize)]
pub struct Standing {
    /// Its version.
    version: u64,
    /// Number of the newest decision.
    decision: i64,
    /// Dimension of features.
    feature_dimension: usize,
    /// By element and slot.
    components: Vec<ComponentStanding>,
}

/// One component of it.
#[derive(Debug, Serialize)]
struct ComponentStanding {
    element: String,
    component: usize,
    /// Calibrated threshold θ of σ.
    threshold: f64,
    /// Environments in the beginning, and now; none if the campaign began with an export alone.
    environments_before: Option<f64>,
    environments: Option<f64>,
    /// Sum of their weights now.
    weighted: Option<f64>,
    /// Of the covariance now.
    condition_number: Option<f64>,
    /// Whether a collection ever changed it.
    moved: bool,
    /// Factor by which the width has grown in the direction in which it grew most, and the least.
    grown: Option<f64>,
    shrunk: Option<f64>,
    /// Of the covariances, √Σ ln²λ.
    distance: Option<f64>,
}

impl Original {
    /// That of the artifact, from where the campaign last found it.
    ///
    /// # Errors
    /// A file that is not there, or is another.
    pub async fn of(store: &Store) -> Result<Self, Failure> {
        let campaign = store.campaign().await?;
        let resolved: Value = serde_json::from_str(&campaign.resolved_configuration)
            .map_err(|error| Failure::Failed(format!("damaged database: the configuration: {error}")))?;
        let files = store.grade_files().await?;
        let (key, load): (_, fn(&Path) -> _) = match &files["calm.artifact"] {
            Value::String(_) => ("calm.artifact", |path| Artifact::load(path)),
            _ => ("potential.model", |path| Artifact::load_export(path)),
        };
        let path = files[key].as_str().ok_or_else(|| {
            Failure::Input(format!("the campaign does not say where its {key} is, which it began with"))
        })?;
        let path = Path::new(path);
        unchanged(path, resolved["files"][key].as_str().unwrap_or_default())?;
        let Artifact { symbols, mixture, .. } = load(path).map_err(Failure::input)?;
        Ok(Self { symbols, mixture })
    }
}

/// How each component stands.
///
/// # Errors
/// A damaged database, a mixture that did not grow from this one.
pub fn standing(original: &Original, newest: &NewestMixture) -> Result<Standing, Failure> {
    let damaged = |error: &dyn ToString| Failure::Failed(format!("the mixture: {}", error.to_string()));
    let now = orchestrator::selector::restored_mixture(&original.mixture, newest.version, &newest.components)
        .map_err(|error| damaged(&error))?;
    let component = |(element, slot, now): (usize, usize, &Arc<Component>)| {
        let symbol = original.symbols.get(element).cloned().unwrap_or_default();
        ComponentStanding::of(symbol, slot, original.mixture.component(element, slot), now)
    };
    let components = now.iter().map(component).collect::<Result<_, _>>().map_err(|error| damaged(&error))?;
    let NewestMixture { version, decision, .. } = *newest;
    Ok(Standing { version, decision, feature_dimension: now.dimension(), components })
}

impl ComponentStanding {
    fn of(
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
