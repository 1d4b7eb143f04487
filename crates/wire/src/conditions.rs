//! The conditions of walks: what one walk from a seed structure has otherwise than another.

use serde::{Deserialize, Serialize};

/// The conditions of a walk.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct WalkConditions {
    /// Name of its group of walks; empty without groups.
    pub group: String,
    /// Temperature of the thermostat, K.
    pub temperature: f64,
    /// Uncertainty-force scale τ at the start of the walk.
    pub tau: f64,
    /// V/V₀ at the first and at the last biased step; `None` for a fixed cell.
    pub volume_ramp: Option<(f64, f64)>,
    /// Number of the walk among those under the same conditions, from 0. They differ in their random numbers.
    pub repeat: u32,
    /// Version of the potential that drives it: 0 is that of the configuration.
    #[serde(default)]
    pub version: u32,
}

/// Which conditions differ between the walks of a campaign.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct VariedConditions {
    group: bool,
    temperature: bool,
    tau: bool,
    volume_ramp: bool,
    repeat: bool,
    version: bool,
}

impl VariedConditions {
    /// The conditions that have more than one value among these walks.
    pub fn among<'a>(walks: impl IntoIterator<Item = &'a WalkConditions>) -> Self {
        let mut walks = walks.into_iter();
        let Some(first) = walks.next() else { return Self::default() };
        walks.fold(Self::default(), |varied, other| Self {
            group: varied.group || other.group != first.group,
            temperature: varied.temperature || other.temperature != first.temperature,
            tau: varied.tau || other.tau != first.tau,
            volume_ramp: varied.volume_ramp || other.volume_ramp != first.volume_ramp,
            repeat: varied.repeat || other.repeat != first.repeat,
            version: varied.version || other.version != first.version,
        })
    }

    /// What distinguishes a walk, as text: `hot, 600 K, V 1 to 1.4, τ 0.15, #2, version 1`. Empty if nothing varies.
    pub fn describe(&self, walk: &WalkConditions) -> String {
        let ramp = match walk.volume_ramp {
            Some((from, to)) => format!("V {from} to {to}"),
            None => "fixed cell".to_owned(),
        };
        let parts = [
            (self.group, walk.group.clone()),
            (self.temperature, format!("{} K", walk.temperature)),
            (self.volume_ramp, ramp),
            (self.tau, format!("τ {}", walk.tau)),
            (self.repeat, format!("#{}", walk.repeat + 1)),
            (self.version, format!("version {}", walk.version)),
        ];
        let parts: Vec<_> = parts.into_iter().filter_map(|(varies, text)| varies.then_some(text)).collect();
        parts.join(", ")
    }

    /// The name of a walk: its seed structure, and what distinguishes it from other walks.
    pub fn name(&self, seed_structure: &str, walk: &WalkConditions) -> String {
        match self.describe(walk).as_str() {
            "" => seed_structure.to_owned(),
            conditions => format!("{seed_structure} ({conditions})"),
        }
    }
}

impl WalkConditions {
    /// Whether the volume changes.
    pub fn changes_volume(&self) -> bool {
        self.volume_ramp.is_some_and(|(from, to)| from != 1.0 || to != 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn walk(group: &str, temperature: f64, repeat: u32) -> WalkConditions {
        WalkConditions {
            group: group.to_owned(),
            temperature,
            tau: 0.15,
            volume_ramp: Some((1.0, 1.4)),
            repeat,
            version: 0,
        }
    }

    #[test]
    fn walks_are_named_by_what_differs() {
        let walks = [walk("hot", 600.0, 0), walk("hot", 900.0, 0), walk("hot", 900.0, 1)];
        let varied = VariedConditions::among(&walks);
        assert_eq!(
            walks.each_ref().map(|walk| varied.describe(walk)),
            ["600 K, #1", "900 K, #1", "900 K, #2"]
        );
        assert_eq!(VariedConditions::among(&walks[..1]).name("fcc", &walks[0]), "fcc");
        let other = WalkConditions { volume_ramp: None, tau: 0.3, ..walk("cold", 600.0, 0) };
        let varied = VariedConditions::among([&walks[0], &other]);
        assert_eq!(varied.name("fcc", &walks[0]), "fcc (hot, V 1 to 1.4, τ 0.15)");
        assert_eq!(varied.name("fcc", &other), "fcc (cold, fixed cell, τ 0.3)");
        let later = WalkConditions { version: 2, ..walks[0].clone() };
        assert_eq!(VariedConditions::among([&walks[0], &later]).describe(&later), "version 2");
    }
}
