//! The conditions of walks: what one walk from a seed structure has otherwise than another.

use serde::{Deserialize, Serialize};

/// The conditions of a walk.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(from = "WrittenConditions", into = "WrittenConditions")]
pub struct WalkConditions {
    /// Name of its group of walks; empty without groups.
    pub group: String,
    /// Temperature of the thermostat, K.
    pub temperature: f64,
    /// Uncertainty-force scale τ at the start of the walk.
    pub tau: f64,
    /// What the cell does.
    pub cell: CellConditions,
    /// Number of the walk among those under the same conditions, from 0. They differ in their random numbers.
    pub repeat: u32,
    /// Version of the potential that drives it: 0 is that of the configuration.
    pub version: u32,
}

/// What the cell of a walk does.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum CellConditions {
    /// It stays.
    #[default]
    Fixed,
    /// Its volume changes linearly.
    VolumeRamp {
        /// V/V₀ at the first biased step.
        from: f64,
        /// V/V₀ at the last one.
        to: f64,
    },
    /// It moves under a pressure.
    ConstantPressure(ConstantPressure),
}

/// The conditions of a walk at constant pressure.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ConstantPressure {
    /// Pressure, bar.
    pub pressure: f64,
    /// V/V₀ at its first step.
    pub start_volume: f64,
    /// Whether its cell is biased.
    pub cell_bias: bool,
}

/// The conditions of a walk as they are written: a key for each kind of cell, as in JSON for users.
#[derive(Serialize, Deserialize)]
struct WrittenConditions {
    group: String,
    temperature: f64,
    tau: f64,
    volume_ramp: Option<(f64, f64)>,
    #[serde(default)]
    constant_pressure: Option<ConstantPressure>,
    repeat: u32,
    #[serde(default)]
    version: u32,
}

impl From<WrittenConditions> for WalkConditions {
    fn from(written: WrittenConditions) -> Self {
        let WrittenConditions { group, temperature, tau, volume_ramp, constant_pressure, repeat, version } =
            written;
        let cell = match (constant_pressure, volume_ramp) {
            (Some(constant), _) => CellConditions::ConstantPressure(constant),
            (None, Some((from, to))) => CellConditions::VolumeRamp { from, to },
            (None, None) => CellConditions::Fixed,
        };
        Self { group, temperature, tau, cell, repeat, version }
    }
}

impl From<WalkConditions> for WrittenConditions {
    fn from(conditions: WalkConditions) -> Self {
        let (volume_ramp, constant_pressure) = (conditions.volume_ramp(), conditions.constant_pressure());
        let WalkConditions { group, temperature, tau, cell: _, repeat, version } = conditions;
        Self { group, temperature, tau, volume_ramp, constant_pressure, repeat, version }
    }
}

/// Which conditions differ between the walks of a campaign.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct VariedConditions {
    group: bool,
    temperature: bool,
    tau: bool,
    cell: bool,
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
            cell: varied.cell || other.cell != first.cell,
            repeat: varied.repeat || other.repeat != first.repeat,
            version: varied.version || other.version != first.version,
        })
    }

    /// What distinguishes a walk, as text: `hot, 600 K, V 1 to 1.4, τ 0.15, #2, version 1`. Empty if nothing varies.
    pub fn describe(&self, walk: &WalkConditions) -> String {
        let parts = [
            (self.group, walk.group.clone()),
            (self.temperature, format!("{} K", walk.temperature)),
            (self.cell, walk.cell_in_words()),
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
        match self.cell {
            CellConditions::Fixed => false,
            CellConditions::VolumeRamp { from, to } => from != 1.0 || to != 1.0,
            CellConditions::ConstantPressure(_) => true,
        }
    }

    /// V/V₀ at the first and at the last biased step, if the volume has a ramp.
    pub fn volume_ramp(&self) -> Option<(f64, f64)> {
        match self.cell {
            CellConditions::VolumeRamp { from, to } => Some((from, to)),
            _ => None,
        }
    }

    /// The conditions of a cell at constant pressure.
    pub fn constant_pressure(&self) -> Option<ConstantPressure> {
        match self.cell {
            CellConditions::ConstantPressure(constant) => Some(constant),
            _ => None,
        }
    }

    /// What the cell does: `fixed cell`, `V 1 to 1.4`, `1 bar`, `1 bar from V 0.94, biased cell`.
    pub fn cell_in_words(&self) -> String {
        match self.cell {
            CellConditions::ConstantPressure(ConstantPressure { pressure, start_volume, cell_bias }) => {
                let start =
                    if start_volume == 1.0 { String::new() } else { format!(" from V {start_volume}") };
                format!("{pressure} bar{start}{}", if cell_bias { ", biased cell" } else { "" })
            }
            CellConditions::VolumeRamp { from, to } => format!("V {from} to {to}"),
            CellConditions::Fixed => "fixed cell".to_owned(),
        }
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
            cell: CellConditions::VolumeRamp { from: 1.0, to: 1.4 },
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
        let other = WalkConditions { cell: CellConditions::Fixed, tau: 0.3, ..walk("cold", 600.0, 0) };
        let varied = VariedConditions::among([&walks[0], &other]);
        assert_eq!(varied.name("fcc", &walks[0]), "fcc (hot, V 1 to 1.4, τ 0.15)");
        assert_eq!(varied.name("fcc", &other), "fcc (cold, fixed cell, τ 0.3)");
        let constant = ConstantPressure { pressure: 1.0, start_volume: 0.94, cell_bias: true };
        let pressed = WalkConditions { cell: CellConditions::ConstantPressure(constant), ..other.clone() };
        let varied = VariedConditions::among([&other, &pressed]);
        assert_eq!(varied.describe(&pressed), "1 bar from V 0.94, biased cell");
        let later = WalkConditions { version: 2, ..walks[0].clone() };
        assert_eq!(VariedConditions::among([&walks[0], &later]).describe(&later), "version 2");
    }

    /// The JSON that users and stores have.
    #[test]
    fn conditions_are_written_with_a_key_for_each_kind_of_cell() {
        let constant = ConstantPressure { pressure: 1.0, start_volume: 0.94, cell_bias: true };
        let cells = [
            (CellConditions::Fixed, r#""volume_ramp":null,"constant_pressure":null"#),
            (
                CellConditions::VolumeRamp { from: 1.0, to: 1.4 },
                r#""volume_ramp":[1.0,1.4],"constant_pressure":null"#,
            ),
            (
                CellConditions::ConstantPressure(constant),
                r#""volume_ramp":null,"constant_pressure":{"pressure":1.0,"start_volume":0.94,"cell_bias":true}"#,
            ),
        ];
        for (cell, expected) in cells {
            let conditions = WalkConditions { cell, ..walk("hot", 600.0, 0) };
            let text = serde_json::to_string(&conditions).unwrap();
            assert!(text.contains(expected), "{text}");
            assert_eq!(serde_json::from_str::<WalkConditions>(&text).unwrap(), conditions);
        }
        let older = r#"{"group":"","temperature":600.0,"tau":0.15,"volume_ramp":[1.0,0.8],"repeat":0}"#;
        let older: WalkConditions = serde_json::from_str(older).unwrap();
        assert_eq!(older.cell, CellConditions::VolumeRamp { from: 1.0, to: 0.8 });
    }
}
