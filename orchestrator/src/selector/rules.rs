//! Rules that may change during a campaign. The decision log records every change, so that decisions depend only on the
//! log.

use calm::forgetting::ForgettingAlarm;
use calm::rules::{Fraction, Positive};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::settings::SelectorSettings;

/// Key under which the rules are committed, and kind of the decision that records a change.
pub(super) const RULES: &str = "rules";
pub(super) const CONFIGURATION: &str = "configuration";

/// The settings that may change and that affect decisions, by configuration key.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ChangeableRules {
    /// See [`SelectorSettings::max_per_walk`].
    #[serde(rename = "collect.max_per_walk")]
    pub max_per_walk: u32,
    /// See [`SelectorSettings::max_per_seed_structure`].
    #[serde(rename = "collect.max_per_seed_structure")]
    pub max_per_seed_structure: Option<u32>,
    /// See [`SelectorSettings::max_structures`]: the smallest of the configured limits.
    #[serde(rename = "collect.max_structures")]
    pub max_structures: Option<u32>,
    /// See [`SelectorSettings::max_steps_without_structure`].
    #[serde(rename = "stop.max_steps_without_structure")]
    pub max_steps_without_structure: Option<u64>,
    /// See [`SelectorSettings::stop_groups`].
    #[serde(rename = "stop.walks", default, skip_serializing_if = "Vec::is_empty")]
    pub stop_groups: Vec<String>,
    /// See [`ForgettingAlarm`].
    #[serde(rename = "calm.forgetting_alarm")]
    pub forgetting_alarm: Fraction,
    /// See [`ForgettingAlarm`].
    #[serde(rename = "calm.max_mean_square_growth")]
    pub max_mean_square_growth: Positive,
}

impl ChangeableRules {
    /// The rules by key.
    pub fn to_map(&self) -> Map<String, Value> {
        let value = serde_json::to_value(self).expect("plain data becomes JSON");
        value.as_object().cloned().unwrap_or_default()
    }
}

impl SelectorSettings {
    /// The rules that may change.
    pub fn changeable_rules(&self) -> ChangeableRules {
        ChangeableRules {
            max_per_walk: self.max_per_walk,
            max_per_seed_structure: self.max_per_seed_structure,
            max_structures: self.max_structures,
            max_steps_without_structure: self.max_steps_without_structure,
            stop_groups: self.stop_groups.clone(),
            forgetting_alarm: self.forgetting_alarm.share_above_one,
            max_mean_square_growth: self.forgetting_alarm.mean_square_growth,
        }
    }

    /// Applies changed rules.
    pub fn apply_rules(&mut self, rules: &ChangeableRules) {
        let ChangeableRules {
            max_per_walk,
            max_per_seed_structure,
            max_structures,
            max_steps_without_structure,
            stop_groups,
            forgetting_alarm,
            max_mean_square_growth,
        } = rules.clone();
        (self.max_per_walk, self.max_structures) = (max_per_walk, max_structures);
        self.max_per_seed_structure = max_per_seed_structure;
        (self.max_steps_without_structure, self.stop_groups) = (max_steps_without_structure, stop_groups);
        self.forgetting_alarm =
            ForgettingAlarm { share_above_one: forgetting_alarm, mean_square_growth: max_mean_square_growth };
    }
}
