//! The decision about a candidate: its numbers and its consequences for other candidates.

use calm::forgetting::GradeDistribution;
use calm::{Staleness, Trial, UpdateEnd, UpdateRule};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use store::records::STALENESS;
use store::{LoggedDecision, Store, StoreError, StoredCandidate};

use super::{CandidateRef, CoveredCandidate};

/// Metadata key under which the leader stores the symbols of the model's elements.
pub const ELEMENTS_KEY: &str = "elements";

/// The decision.
#[derive(Clone, Debug, Serialize)]
pub struct DecisionDetails {
    /// Its number.
    pub number: i64,
    /// Round in reproducible mode, otherwise 0.
    pub round: u64,
    /// `accepted`, `declined` or `control`.
    pub kind: String,
    /// Why it was declined: `covered`, `duplicate`, `too_close`, `budget`, `backlog`,
    /// `unlikely_to_complete` or `grade_too_large`.
    pub reason: Option<String>,
    /// Factor by which a long label queue had raised the threshold.
    pub raised_by: Option<f64>,
    /// The raised threshold.
    pub raised_threshold: Option<f64>,
    /// Predicted probability that its label completes, if `collect.min_completion_probability` was in force.
    pub completion_probability: Option<f64>,
    /// The smallest probability that was accepted.
    pub min_completion_probability: Option<f64>,
    /// Version of the mixture afterwards.
    pub mixture_version: u64,
    /// The update that made the mixture cover the candidate.
    pub update: Option<UpdateDetails>,
    /// Relations to other candidates by coverage.
    pub coverage: Coverage,
}

/// An update of the mixture.
#[derive(Clone, Debug, Serialize)]
pub struct UpdateDetails {
    /// The configured rule that chooses α.
    pub rule: Option<UpdateRule>,
    /// Convex or additive.
    pub covariance_update: Option<String>,
    /// The recorded result.
    #[serde(flatten)]
    pub found: LoggedUpdate,
    /// Element symbol of each of `components`. `None` in campaigns that began before elements were recorded.
    pub component_elements: Vec<Option<String>>,
    /// γ of the potential's training frames under the updated mixture.
    pub training_frames: Option<GradeDistribution>,
    /// Whether this raised the forgetting alarm.
    pub forgetting_alarm: Option<bool>,
}

/// An update as the decision log records it.
#[derive(Clone, Debug, Deserialize, Serialize)]
pub struct LoggedUpdate {
    /// The chosen α.
    pub alpha: f64,
    /// Every α that was tried, with its result.
    pub trials: Vec<Trial>,
    /// What ended the search.
    pub ended_by: UpdateEnd,
    /// Factors on the scatter matrix in each round of inflation.
    pub inflations: Vec<f64>,
    /// Largest γ of the structure after the update.
    pub gamma_max_after: Option<f64>,
    /// The changed components: index of the element in the model, and number of the component.
    pub components: Vec<(u32, u32)>,
}

/// Which candidates covered which.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Coverage {
    /// For a candidate declined as covered: the candidates whose updates its walker had not seen, newest first.
    pub by: Vec<CandidateRef>,
    /// For a candidate that updated the mixture: later candidates that were declined as covered while their walkers
    /// had not seen the update. If `decided` − `seen` is 1, this update alone covered them, otherwise the updates of
    /// those versions together.
    pub later: Vec<CoveredCandidate>,
    /// The last decision that was checked for that, if there are more.
    pub searched_until: Option<i64>,
}

impl DecisionDetails {
    pub(super) async fn read(
        store: &Store,
        logged: &LoggedDecision,
        stored: &StoredCandidate,
        rules: &Value,
    ) -> Result<Self, StoreError> {
        let detail = &logged.detail;
        let update = UpdateDetails::parse(detail, rules, &elements(store).await?)?;
        let mut coverage = Coverage::default();
        let reason = detail["reason"].as_str().map(str::to_owned);
        if reason.as_deref() == Some("covered") {
            coverage.by = store.updates_since(stored.block.view().mixture_version(), logged.sequence).await?;
        }
        if update.is_some() {
            let most = largest_staleness(store).await?;
            let later = store.covered_since(logged.sequence, logged.mixture_version, most).await?;
            (coverage.later, coverage.searched_until) = (later.candidates, later.searched_until);
        }
        Ok(Self {
            number: logged.sequence,
            round: logged.round,
            kind: logged.kind.clone(),
            reason,
            raised_by: detail["raised_by"].as_f64(),
            raised_threshold: detail["threshold"].as_f64(),
            completion_probability: detail["completion"]["probability"].as_f64(),
            min_completion_probability: detail["completion"]["min_probability"].as_f64(),
            mixture_version: logged.mixture_version,
            update,
            coverage,
        })
    }
}

impl UpdateDetails {
    fn parse(detail: &Value, rules: &Value, elements: &[String]) -> Result<Option<Self>, StoreError> {
        let damaged = |error| StoreError::damaged("the decision log", error);
        let Some(found) = detail.get("update") else { return Ok(None) };
        let found: LoggedUpdate = serde_json::from_value(found.clone()).map_err(damaged)?;
        let symbol = |(element, _): &(u32, u32)| elements.get(*element as usize).cloned();
        let training_frames = detail.get("training_frames").cloned().map(serde_json::from_value);
        Ok(Some(Self {
            rule: serde_json::from_value(rules["collect"]["update_target"].clone()).ok(),
            covariance_update: rules["calm"]["covariance_update"].as_str().map(str::to_owned),
            component_elements: found.components.iter().map(symbol).collect(),
            found,
            training_frames: training_frames.transpose().map_err(damaged)?,
            forgetting_alarm: detail["forgetting_alarm"].as_bool(),
        }))
    }
}

/// Symbols of the model's elements, in the model's order. Empty in campaigns of earlier versions.
async fn elements(store: &Store) -> Result<Vec<String>, StoreError> {
    let metadata = store.metadata(ELEMENTS_KEY).await?;
    Ok(metadata.and_then(|text| serde_json::from_str(&text).ok()).unwrap_or_default())
}

/// Largest number of versions by which a walker's mixture was older than the selector's. `None` in campaigns of
/// earlier versions.
async fn largest_staleness(store: &Store) -> Result<Option<u64>, StoreError> {
    let values = store.values().await?;
    let found = values.iter().find(|(name, _)| name == STALENESS);
    let found = found.and_then(|(_, text)| serde_json::from_str::<Staleness>(text).ok());
    Ok(found.map(|staleness| staleness.largest()))
}
