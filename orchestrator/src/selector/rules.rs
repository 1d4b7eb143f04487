//! Rules that may change while a campaign lasts. The decision log says when: decisions follow from it and from nothing
//! else.

use calm::forgetting::ForgettingAlarm;
use calm::rules::Fraction;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::Settings;

/// The value under which they are committed, and the kind of the decision that says that they have changed.
pub(super) const RULES: &str = "rules";
pub(super) const CONFIGURATION: &str = "configuration";

/// Those of the settings that may change and that decisions depend on, by the keys of the configuration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ChangeableRules {
    /// See [`Settings::per_seed`].
    #[serde(rename = "collect.per_seed")]
    pub per_seed: u32,
    /// See [`Settings::total`]: the least of what the keys say that limit it.
    #[serde(rename = "collect.total")]
    pub total: Option<u32>,
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
    pub fn changeable(&self) -> ChangeableRules {
        ChangeableRules {
            per_seed: self.per_seed,
            total: self.total,
            forgetting_alarm: self.forgetting_alarm.share_above_one,
        }
    }

    /// Takes others from now on.
    pub fn change(&mut self, rules: &ChangeableRules) {
        let ChangeableRules { per_seed, total, forgetting_alarm } = *rules;
        (self.per_seed, self.total) = (per_seed, total);
        self.forgetting_alarm = ForgettingAlarm { share_above_one: forgetting_alarm };
    }
}
