//! What was decided, by which numbers, and what followed from it for others.

use calm::watch::GradeDistribution;
use calm::{Trial, UpdateEnd, UpdateRule};
use orchestrator::selector::{STALENESS, Staleness};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use store::{LoggedDecision, Store, StoreError, StoredCandidate};

use super::{CandidateRef, CoveredCandidate};

/// Under which name the leader of a campaign leaves the symbols of the model's elements.
pub const ELEMENTS: &str = "elements";

/// The decision.
#[derive(Clone, Debug, Serialize)]
pub struct Decided {
    /// Its number.
    pub number: i64,
    /// Round (reproducible mode) or 0.
    pub round: u64,
    /// `accepted`, `declined` or `control`.
    pub kind: String,
    /// Why it was declined: `covered`, `duplicate`, `guard`, `budget`, `backlog`.
    pub reason: Option<String>,
    /// Factor by which the threshold was raised, since many structures waited for labels.
    pub raised_by: Option<f64>,
    /// The threshold with it.
    pub raised_threshold: Option<f64>,
    /// Version of the mixture afterwards.
    pub mixture_version: u64,
    /// How the mixture was made to cover it.
    pub update: Option<Update>,
    /// What came of that.
    pub coverage: Coverage,
}

/// An update of the mixture.
#[derive(Clone, Debug, Serialize)]
pub struct Update {
    /// The rule by which α is chosen, as configured.
    pub rule: Option<UpdateRule>,
    /// Convex or additive.
    pub combination: Option<String>,
    /// What was found.
    #[serde(flatten)]
    pub found: FoundUpdate,
    /// Symbol of the element of each of `components`; none in campaigns that began before elements were recorded.
    pub component_elements: Vec<Option<String>>,
    /// γ of the potential's training frames under the mixture afterwards.
    pub training_frames: Option<GradeDistribution>,
    /// Whether that raised the alarm over forgetting.
    pub forgetting_alarm: Option<bool>,
}

/// As the decision log has it.
#[derive(Clone, Debug, Deserialize, Serialize)]
pub struct FoundUpdate {
    /// The α that was taken.
    pub alpha: f64,
    /// Every α that was tried, and what it reached.
    pub trials: Vec<Trial>,
    /// What ended the search.
    pub ended_by: UpdateEnd,
    /// Factors of the scatter in rounds of inflation.
    pub inflations: Vec<f64>,
    /// Largest γ of the structure afterwards.
    pub gamma_max_after: Option<f64>,
    /// The components that it changed: index of the element in the model, and number of the component.
    pub components: Vec<(u32, u32)>,
}

/// Who covered whom.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Coverage {
    /// Of a candidate that was declined as covered: whose updates its walker had not seen, newest first.
    pub by: Vec<CandidateRef>,
    /// Of one that updated the mixture: later candidates that were declined as covered, and whose walkers had not seen
    /// that update. If `decided` − `seen` is 1 it was this update alone, otherwise this and others of those versions.
    pub later: Vec<CoveredCandidate>,
    /// The last decision that was looked at for that, if there are more.
    pub looked_until: Option<i64>,
}

impl Decided {
    pub(super) async fn read(
        store: &Store,
        logged: &LoggedDecision,
        stored: &StoredCandidate,
        rules: &Value,
    ) -> Result<Self, StoreError> {
        let detail = &logged.detail;
        let update = Update::of(detail, rules, &elements(store).await?)?;
        let mut coverage = Coverage::default();
        let reason = detail["reason"].as_str().map(str::to_owned);
        if reason.as_deref() == Some("covered") {
            coverage.by = store.updates_since(stored.block.view().mixture_version(), logged.sequence).await?;
        }
        if update.is_some() {
            let most = largest_staleness(store).await?;
            let later = store.covered_since(logged.sequence, logged.mixture_version, most).await?;
            (coverage.later, coverage.looked_until) = (later.candidates, later.looked_until);
        }
        Ok(Self {
            number: logged.sequence,
            round: logged.round,
            kind: logged.kind.clone(),
            reason,
            raised_by: detail["raised_by"].as_f64(),
            raised_threshold: detail["threshold"].as_f64(),
            mixture_version: logged.mixture_version,
            update,
            coverage,
        })
    }
}

impl Update {
    fn of(detail: &Value, rules: &Value, elements: &[String]) -> Result<Option<Self>, StoreError> {
        let damaged = |error| StoreError::damaged("the decision log", error);
        let Some(found) = detail.get("update") else { return Ok(None) };
        let found: FoundUpdate = serde_json::from_value(found.clone()).map_err(damaged)?;
        let symbol = |(element, _): &(u32, u32)| elements.get(*element as usize).cloned();
        let training_frames = detail.get("training_frames").cloned().map(serde_json::from_value);
        Ok(Some(Self {
            rule: serde_json::from_value(rules["collect"]["until"].clone()).ok(),
            combination: rules["calm"]["combination"].as_str().map(str::to_owned),
            component_elements: found.components.iter().map(symbol).collect(),
            found,
            training_frames: training_frames.transpose().map_err(damaged)?,
            forgetting_alarm: detail["forgetting_alarm"].as_bool(),
        }))
    }
}

/// Symbols of the model's elements, in its order; none in campaigns of earlier versions.
async fn elements(store: &Store) -> Result<Vec<String>, StoreError> {
    let note = store.metadata(ELEMENTS).await?;
    Ok(note.and_then(|note| serde_json::from_str(&note).ok()).unwrap_or_default())
}

/// By how many versions the mixture of a walker was ever older than the selector's; none in campaigns of earlier versions.
async fn largest_staleness(store: &Store) -> Result<Option<u64>, StoreError> {
    let values = store.values().await?;
    let found = values.iter().find(|(name, _)| name == STALENESS);
    let found = found.and_then(|(_, text)| serde_json::from_str::<Staleness>(text).ok());
    Ok(found.map(|staleness| staleness.largest()))
}
