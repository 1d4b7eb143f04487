//! Rules that may change while a campaign lasts. The decision log says when: decisions follow from it and from nothing
//! else.

use calm::rules::Fraction;
use calm::watch::ForgettingAlarm;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::Settings;

/// The value under which they are committed, and the kind of the decision that says that they have changed.
pub(super) const RULES: &str = "rules";
pub(super) const CONFIGURATION: &str = "configuration";

/// Those of the settings that may change and that decisions depend on, by the keys of the configuration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ChangeableRules {
    /// See [`Settings::max_per_seed_structure`].
    #[serde(rename = "collect.per_seed")]
    pub max_per_seed_structure: u32,
    /// See [`Settings::max_structures`]: the least of what the keys say that limit it.
    #[serde(rename = "collect.total")]
    pub max_structures: Option<u32>,
    /// See [`ForgettingAlarm`].
    #[serde(rename = "calm.forgetting_alarm")]
    pub forgetting_alarm: Fraction,
}

impl ChangeableRules {
    /// By key.
    pub fn to_map(&self) -> Map<String, Value> {
        let value = serde_json::to_value(self).expect("plain data becomes JSON");
        value.as_object().cloned().unwrap_or_default()
    }
}

impl Settings {
    /// Those that may change.
    pub fn changeable_rules(&self) -> ChangeableRules {
        ChangeableRules {
            max_per_seed_structure: self.max_per_seed_structure,
            max_structures: self.max_structures,
            forgetting_alarm: self.forgetting_alarm.share_above_one,
        }
    }

    /// Takes others from now on.
    pub fn apply_rules(&mut self, rules: &ChangeableRules) {
        let ChangeableRules { max_per_seed_structure, max_structures, forgetting_alarm } = *rules;
        (self.max_per_seed_structure, self.max_structures) = (max_per_seed_structure, max_structures);
        self.forgetting_alarm = ForgettingAlarm { share_above_one: forgetting_alarm };
    }
}
