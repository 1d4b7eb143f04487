//! Values of keys that are left out.

use std::num::{NonZeroU32, NonZeroU64};

use calm::rules::{Fraction, Positive};
use md::{LangevinSettings, ThermostatSettings};
use orchestrator::selector::UpdateProtocol;
use store::LowerStateRule;
use workers::labeller::LabelBounds;

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
    UpdateProtocol::Cumulative
}

pub fn equilibration_steps() -> u64 {
    500
}

pub fn thermostat() -> ThermostatSettings {
    ThermostatSettings::Langevin(LangevinSettings { friction: 0.01 })
}

/// As in the paper.
pub fn reference_steps() -> u64 {
    5000
}

pub fn start_volume() -> Positive {
    positive(1.0)
}

pub fn bias_averaging_steps() -> NonZeroU64 {
    nonzero(10).into()
}

pub fn bias_norm_interval() -> NonZeroU64 {
    NonZeroU64::MIN
}

/// Small against the time in which a structure becomes new, and a hundredth of the cost of a control walk at most.
pub fn trace_interval() -> u64 {
    50
}

pub fn skin() -> Positive {
    positive(0.5)
}

pub fn min_interval() -> u64 {
    200
}

pub fn min_interval_after_decline() -> NonZeroU64 {
    nonzero(20).into()
}

pub fn max_mean_square_growth() -> Positive {
    positive(4.0)
}

pub fn repeats() -> NonZeroU32 {
    NonZeroU32::MIN
}

pub fn max_per_walk() -> NonZeroU32 {
    nonzero(3)
}

pub fn declined_features() -> u64 {
    1000
}

pub fn concurrency() -> usize {
    1
}

pub fn lease_timeout() -> Duration {
    Duration::from_seconds(600)
}

/// As many as the longest ladder of retry adjustments has steps.
pub fn max_attempts() -> NonZeroU32 {
    nonzero(4)
}

pub fn cores() -> NonZeroU32 {
    nonzero(1)
}

pub fn time_limit() -> Duration {
    Duration::from_seconds(86_400)
}

pub fn max_force() -> Positive {
    positive(LabelBounds::default().max_force)
}

pub fn max_stress() -> Positive {
    positive(LabelBounds::default().max_stress)
}

pub fn max_energy_per_atom() -> Positive {
    positive(LabelBounds::default().max_energy_per_atom)
}

pub fn max_energy_difference_per_atom() -> Positive {
    positive(LabelBounds::default().max_energy_difference_per_atom)
}

pub fn min_state_difference() -> Positive {
    positive(LowerStateRule::default().min_difference)
}

pub fn queue_limit() -> NonZeroU32 {
    nonzero(1000)
}

pub fn replay_weight() -> Positive {
    positive(1.0)
}

pub fn max_versions() -> NonZeroU32 {
    nonzero(3)
}

pub fn held_out() -> f64 {
    0.1
}

pub fn max_replay_error_ratio() -> Positive {
    positive(3.0)
}

pub fn max_held_out_error_ratio() -> Positive {
    positive(1.0)
}

pub fn refit_attempts() -> NonZeroU32 {
    nonzero(3)
}

pub fn max_batch() -> NonZeroU32 {
    nonzero(32)
}

pub fn python_timeout() -> Duration {
    Duration::from_seconds(60)
}

pub fn compile_timeout() -> Duration {
    Duration::from_seconds(600)
}
