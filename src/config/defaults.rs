//! Values of keys that are left out.

use std::num::{NonZeroU32, NonZeroU64};

use calm::rules::{Fraction, Positive};
use orchestrator::selector::UpdateProtocol;
use workers::labeller::LabelBounds;
use workers::settings::ThermostatKind;

use crate::duration::Duration;

pub fn positive(x: f64) -> Positive {
    Positive::try_from(x).expect("a default above 0")
}

pub fn fraction(x: f64) -> Fraction {
    Fraction::try_from(x).expect("a default between 0 and 1")
}

pub fn nonzero(x: u32) -> NonZeroU32 {
    NonZeroU32::new(x).expect("a default above 0")
}

pub fn forgetting_alarm() -> Fraction {
    fraction(0.2)
}

pub fn update() -> UpdateProtocol {
    UpdateProtocol::Carried
}

pub fn equilibration() -> u64 {
    500
}

pub fn thermostat() -> ThermostatKind {
    ThermostatKind::Langevin { friction: 0.01 }
}

pub fn average_steps() -> NonZeroU64 {
    nonzero(10).into()
}

pub fn skin() -> Positive {
    positive(0.5)
}

pub fn gap() -> u64 {
    200
}

pub fn declined_gap() -> NonZeroU64 {
    nonzero(20).into()
}

pub fn per_seed() -> NonZeroU32 {
    nonzero(3)
}

pub fn declined_features() -> u64 {
    1000
}

pub fn slots() -> usize {
    1
}

pub fn lease() -> Duration {
    Duration::from_seconds(600)
}

/// As many as the longest ladder of remedies has steps.
pub fn attempts() -> NonZeroU32 {
    nonzero(4)
}

pub fn cores() -> NonZeroU32 {
    nonzero(1)
}

pub fn time_limit() -> Duration {
    Duration::from_seconds(86_400)
}

pub fn largest_force() -> Positive {
    positive(LabelBounds::default().largest_force)
}

pub fn largest_stress() -> Positive {
    positive(LabelBounds::default().largest_stress)
}

pub fn largest_energy() -> Positive {
    positive(LabelBounds::default().largest_energy)
}

pub fn largest_energy_difference() -> Positive {
    positive(LabelBounds::default().largest_energy_difference)
}

pub fn queue_limit() -> NonZeroU32 {
    nonzero(1000)
}
