//! What a selector works with: settings, seed structures, and the stored state.

use atoms::{MinDistanceRule, Structure};
use calm::forgetting::ForgettingAlarm;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use store::VersionRecord;
use store::records::{ComponentRecord, WalkRecord};
use wire::{ContentHash, WalkConditions};

/// Whether a campaign is reproducible bit by bit, or walks never wait for each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum CampaignMode {
    /// Walks advance in rounds. Decisions do not depend on the number of walkers or on their speed.
    Reproducible,
    /// The mixture is updated as candidates arrive.
    Live,
}

impl CampaignMode {
    /// The serialized name: `"reproducible"` or `"live"`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Reproducible => "reproducible",
            Self::Live => "live",
        }
    }
}

/// What happens to the mixture between walks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum UpdateProtocol {
    /// Updates accumulate over all walks.
    Cumulative,
    /// Each seed structure starts from the original mixture.
    PerSeedStructure,
    /// Each walk starts from the original mixture.
    PerWalk,
    /// The mixture is never updated.
    Never,
}

/// What happens when the mixture has forgotten too much of the training data.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum OnForgetting {
    /// Print a warning and continue.
    #[default]
    Warn,
    /// Stop the run; resume after raising the limit.
    Pause,
    /// Make later updates additive, which forget nothing.
    Additive,
}

/// A version of the potential: model, mixture and thresholds together.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PotentialVersion {
    /// Its number; 0 is that of the configuration.
    pub version: u32,
    /// The version from which it was trained.
    pub parent: u32,
    /// BLAKE3 hash of the model's file, hexadecimal; empty for version 0.
    pub model: String,
    /// The same of the mixture's file.
    pub mixture: String,
}

impl From<&VersionRecord> for PotentialVersion {
    fn from(record: &VersionRecord) -> Self {
        Self {
            version: record.number,
            parent: record.parent,
            model: record.model_hash.clone(),
            mixture: record.mixture_hash.clone(),
        }
    }
}

/// The settings of the selector.
#[derive(Clone, Debug)]
pub struct SelectorSettings {
    /// Reproducible or live.
    pub mode: CampaignMode,
    /// Number of biased walks that advance together in a round.
    pub walks_per_round: usize,
    /// Number of steps in an assignment.
    pub steps_per_assignment: u64,
    /// What happens to the mixture between walks.
    pub update: UpdateProtocol,
    /// How the covariance is updated, and when the search for α stops.
    pub search: calm::UpdateSettings,
    /// When the mixture has forgotten too much of the training data.
    pub forgetting_alarm: ForgettingAlarm,
    /// What happens then.
    pub on_forgetting: OnForgetting,
    /// When a structure is a candidate.
    pub collection: calm::CollectionRule,
    /// Maximum number of structures accepted from one walk.
    pub max_per_walk: u32,
    /// Maximum number of structures accepted from all walks of one seed structure, with each version of the potential.
    pub max_per_seed_structure: Option<u32>,
    /// Maximum number of structures accepted in the campaign.
    pub max_structures: Option<u32>,
    /// Maximum number of steps that the biased walks make together after the last accepted structure, equilibration included.
    pub max_steps_without_structure: Option<u64>,
    /// Groups of walks whose steps and structures count for that; empty: all.
    pub stop_groups: Vec<String>,
    /// Whether each biased walk that collected structures is followed by its unbiased control walk.
    pub control: bool,
    /// Share of the assignments that control walks get while there are any (live mode).
    pub control_share: f64,
    /// How close atoms may come. Structures with closer atoms are declined.
    pub min_distances: MinDistanceRule,
    /// γ_max under the original mixture above which candidates are declined.
    pub max_grade: Option<f64>,
    /// Maximum size of the stored feature vectors of declined candidates, bytes.
    pub declined_feature_bytes: u64,
    /// The version of the potential in force. Every walk of the plan starts anew with each version.
    pub version: PotentialVersion,
    /// Number of structures, accepted in the whole campaign, at which biased walks make room for a new version.
    pub refit_at: Option<u32>,
}

/// The start of walks.
#[derive(Clone, Debug)]
pub struct SeedStructurePlan {
    /// Name.
    pub name: String,
    /// Structure.
    pub structure: Structure,
    /// The conditions of each of its biased walks, in order.
    pub walks: Vec<WalkConditions>,
}

/// The state of a selector, as restored from a store.
#[derive(Clone, Debug, Default)]
pub struct SelectorSnapshot {
    /// Every walk.
    pub walks: Vec<WalkRecord>,
    /// Components that differ from the original mixture.
    pub components: Vec<ComponentRecord>,
    /// Hashes of the known structures.
    pub known: Vec<ContentHash>,
    /// Number of known structures that were imported.
    pub imported: u64,
    /// Values of past commits.
    pub values: Vec<(String, String)>,
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};
    use store::VersionState;

    use super::*;

    #[test]
    fn modes_have_their_serialized_names() {
        for mode in [CampaignMode::Reproducible, CampaignMode::Live] {
            assert_eq!(json!(mode), mode.name());
        }
    }

    #[test]
    fn a_version_is_that_of_its_record() {
        let record = VersionRecord {
            number: 3,
            parent: 1,
            state: VersionState::Registered,
            reason: String::new(),
            method: "native".to_owned(),
            structures: 0,
            last_decision: 0,
            labels: 0,
            model_hash: "a".to_owned(),
            mixture_hash: "b".to_owned(),
            figures: Value::Null,
            seconds: 0.0,
            core_hours: 0.0,
            time: 0,
        };
        let (model, mixture) = ("a".to_owned(), "b".to_owned());
        assert_eq!(
            PotentialVersion::from(&record),
            PotentialVersion { version: 3, parent: 1, model, mixture }
        );
    }
}
