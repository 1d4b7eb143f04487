//! Compares a replay with the recorded campaign.

use std::collections::BTreeMap;

use orchestrator::selector::{Replay, ReplayError, ReplayedDecision};
use serde::Serialize;
use serde_json::{Value, json};
use store::{AtomGrades, LoggedDecision, NewestMixture, StoredCandidate};

use super::RuleOverride;

/// Result of a replay.
#[derive(Clone, Debug, Serialize)]
pub struct ReplayReport {
    /// Id of the campaign.
    pub campaign: String,
    /// Overridden keys with their values.
    pub set: BTreeMap<String, String>,
    /// Decisions that the campaign has.
    pub recorded: i64,
    /// Decisions that were replayed.
    pub replayed: i64,
    /// Recorded fates of the replayed candidates of biased walks.
    pub before: FateCounts,
    /// Fates in the replay.
    pub now: FateCounts,
    /// Accepted in the campaign but not in the replay.
    pub no_longer_accepted: Vec<FateChange>,
    /// Accepted in the replay but not in the campaign.
    pub newly_accepted: Vec<FateChange>,
    /// Walks that ended with a quota and would continue in the replay. What they would find is unknown.
    pub walks_cut_short: u64,
    /// Where the replay had to stop, if it did.
    pub stopped: Option<MissingFeatures>,
    /// With unchanged rules: the first difference from the record.
    pub difference: Option<Difference>,
    /// With unchanged rules, at the end: whether the mixture equals the stored one byte for byte.
    pub same_mixture: Option<bool>,
    /// Duration, s.
    pub seconds: f64,
    /// Whether this processor may round differently from the one of the campaign.
    pub other_processor: bool,
}

/// Numbers of candidates by fate.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct FateCounts {
    /// All candidates.
    pub candidates: u64,
    /// Accepted.
    pub accepted: u64,
    /// Declined, by reason; `walk over` if their walk would have ended before.
    pub declined: BTreeMap<String, u64>,
    /// Final version of the mixture.
    pub mixture_version: u64,
}

/// A candidate with another fate in the replay.
#[derive(Clone, Debug, Serialize)]
pub struct FateChange {
    /// Number of the decision.
    pub decision: i64,
    /// Name of the candidate.
    pub candidate: String,
    /// Its walk.
    pub walk: u32,
    /// Its step.
    pub step: u64,
    /// γ_max under the selector's mixture, in the campaign and in the replay.
    pub gamma_max: (Option<f64>, Option<f64>),
    /// Why it was declined, in either.
    pub reason: String,
}

/// Where a replay stops because the candidate's features were not kept.
#[derive(Clone, Debug, Serialize)]
pub struct MissingFeatures {
    /// Number of the decision.
    pub decision: i64,
    /// Name of the candidate.
    pub candidate: String,
    /// Its walk.
    pub walk: u32,
    /// Its step.
    pub step: u64,
}

/// A difference from the record.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// Number of the decision.
    pub decision: i64,
    /// Which value differs; within JSON, by its path.
    pub what: String,
    /// The recorded value.
    pub recorded: Value,
    /// The value in the replay.
    pub now: Value,
}

/// An entry of the decision log.
pub struct LogEntry<'a> {
    /// The decision.
    pub decision: &'a LoggedDecision,
    /// Its candidate.
    pub candidate: Option<&'a StoredCandidate>,
}

impl ReplayReport {
    /// An empty report.
    pub fn new(
        campaign: &store::CampaignRecord,
        settings: &[RuleOverride],
        other_processor: bool,
        recorded: i64,
    ) -> Self {
        let set = settings.iter().map(|setting| (setting.key.clone(), setting.value.to_string()));
        Self {
            campaign: campaign.id.to_string(),
            set: set.collect(),
            recorded,
            replayed: 0,
            before: FateCounts::default(),
            now: FateCounts::default(),
            no_longer_accepted: Vec::new(),
            newly_accepted: Vec::new(),
            walks_cut_short: 0,
            stopped: None,
            difference: None,
            same_mixture: None,
            seconds: 0.0,
            other_processor,
        }
    }

    /// Adds an entry of the log and its outcome in the replay.
    pub fn add(&mut self, recorded: LogEntry<'_>, now: Option<ReplayedDecision>, exact: bool) {
        let decision = recorded.decision;
        self.replayed = decision.sequence;
        self.before.mixture_version = decision.mixture_version;
        if exact {
            self.difference = difference(&recorded, now.as_ref());
        }
        if !matches!(decision.kind.as_str(), "accepted" | "declined") {
            return;
        }
        let now = now.map(|now| now.decision);
        let now_reason = match &now {
            Some(now) => reason(now.kind, &now.detail),
            None => Some("walk over".to_owned()),
        };
        let before_reason = reason(&decision.kind, &decision.detail);
        self.before.count(before_reason.as_deref());
        self.now.count(now_reason.as_deref());
        let gamma_max = |detail: &Value| detail["selector"]["gamma_max"].as_f64();
        let change = |reason| FateChange {
            decision: decision.sequence,
            candidate: decision.candidate.clone().unwrap_or_default(),
            walk: decision.walk.unwrap_or_default(),
            step: recorded.candidate.map_or_else(|| step(decision), |stored| stored.block.view().id().step),
            gamma_max: (gamma_max(&decision.detail), now.as_ref().and_then(|now| gamma_max(&now.detail))),
            reason,
        };
        match (before_reason, now_reason) {
            (None, Some(reason)) => self.no_longer_accepted.push(change(reason)),
            (Some(reason), None) => self.newly_accepted.push(change(reason)),
            _ => {}
        }
    }

    /// Records that the replay cannot continue with this decision.
    pub fn stop(&mut self, decision: &LoggedDecision) {
        self.stopped = Some(MissingFeatures {
            decision: decision.sequence,
            candidate: decision.candidate.clone().unwrap_or_default(),
            walk: decision.walk.unwrap_or_default(),
            step: step(decision),
        });
    }

    /// Adds the result at the end.
    pub fn close(&mut self, replay: &Replay, end: &NewestMixture) -> Result<(), ReplayError> {
        self.now.mixture_version = replay.mixture().version();
        self.walks_cut_short = replay.cut_short();
        if !replay.is_exact() || self.stopped.is_some() || self.difference.is_some() {
            return Ok(());
        }
        let other = replay.first_different_component(end.version, &end.components)?;
        self.same_mixture = Some(other.is_none());
        self.difference = other.map(|(element, slot)| Difference {
            decision: end.decision,
            what: format!("the mixture after it, component {slot} of element {element}"),
            recorded: json!("the bytes in the database"),
            now: json!("other bytes"),
        });
        Ok(())
    }
}

impl FateCounts {
    fn count(&mut self, reason: Option<&str>) {
        self.candidates += 1;
        match reason {
            None => self.accepted += 1,
            Some(reason) => *self.declined.entry(reason.to_owned()).or_default() += 1,
        }
    }
}

/// Why a candidate was declined. `None` if it was accepted.
fn reason(kind: &str, detail: &Value) -> Option<String> {
    (kind == "declined").then(|| detail["reason"].as_str().unwrap_or_default().to_owned())
}

/// The step in the name of a decision's candidate, `campaign-walk.segment.step-content`.
fn step(decision: &LoggedDecision) -> u64 {
    let place = decision.candidate.as_ref().and_then(|name| name.split('-').nth(1));
    place.and_then(|place| place.rsplit('.').next()).and_then(|step| step.parse().ok()).unwrap_or_default()
}

/// The first difference between a decision and its record.
fn difference(recorded: &LogEntry<'_>, now: Option<&ReplayedDecision>) -> Option<Difference> {
    let before = recorded.decision;
    let as_json = |kind: &str, walk: Option<u32>, candidate: Option<String>, version: u64, detail: &Value| {
        json!({
            "kind": kind, "walk": walk, "candidate": candidate, "mixture_version": version, "detail": detail,
        })
    };
    let LoggedDecision { kind, walk, candidate, mixture_version, detail, .. } = before;
    let old = as_json(kind, *walk, candidate.clone(), *mixture_version, detail);
    let new = now.map_or(Value::Null, |ReplayedDecision { decision: now, .. }| {
        let (walk, candidate) = (now.walk.map(|walk| walk.0), now.candidate.map(|id| id.to_string()));
        as_json(now.kind, walk, candidate, now.mixture_version, &now.detail)
    });
    let grades = recorded.candidate.zip(now.and_then(|now| now.candidate.as_ref()));
    let place = first_difference("decision", &old, &new).or_else(|| {
        let (before, now) = grades?;
        let pairs =
            [("selector", &before.selector, &now.selector), ("original", &before.original, &now.original)];
        let (name, before, now) = pairs.into_iter().find(|(_, before, now)| before != now)?;
        Some((format!("grades of the atoms ({name})"), json!(all(before)), json!(all(now))))
    });
    let (what, recorded, now) = place?;
    Some(Difference { decision: before.sequence, what, recorded, now })
}

fn all(grades: &AtomGrades) -> Vec<f64> {
    [grades.gamma.as_slice(), &grades.gamma_nbr].concat()
}

/// The first path at which two JSON values have different texts.
pub fn first_difference(path: &str, before: &Value, now: &Value) -> Option<(String, Value, Value)> {
    if let (Value::Object(old), Value::Object(new)) = (before, now) {
        let keys = old.keys().chain(new.keys().filter(|key| !old.contains_key(*key)));
        let null = Value::Null;
        let mut keys = keys.map(|key| (key, old.get(key).unwrap_or(&null), new.get(key).unwrap_or(&null)));
        return keys.find_map(|(key, old, new)| first_difference(&format!("{path}.{key}"), old, new));
    }
    let [old, new] = [before, now].map(Value::to_string);
    (old != new).then(|| (path.to_owned(), before.clone(), now.clone()))
}
