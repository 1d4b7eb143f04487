//! The sections of walks: `[walk]` and `[[walks]]`.

use std::num::{NonZeroU32, NonZeroU64};

use atoms::units::GPA_PER_EV_A3;
use calm::rules::Positive;
use md::{BarostatSettings, ThermostatSettings};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use workers::cell_bias::CellBiasSettings;

use super::{defaults, schema};

/// `[walk]`
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WalkSection {
    /// Temperature of the thermostat, K.
    pub temperature: Positive,
    /// Number of biased steps.
    pub biased_steps: NonZeroU64,
    /// Number of unbiased steps before the biased ones.
    #[serde(default = "defaults::equilibration_steps")]
    pub equilibration_steps: u64,
    /// Scale τ of the uncertainty force.
    pub tau: Positive,
    /// Time step, fs. Default: 2 fs, or 0.5 fs with H, He, Li or Be.
    #[serde(default)]
    pub time_step: Option<Positive>,
    /// Thermostat: Langevin, Nosé–Hoover or velocity rescaling.
    #[serde(default = "defaults::thermostat")]
    #[schemars(transform = schema::without_none)]
    pub thermostat: ThermostatSettings,
    /// Linear change of the volume over the biased steps. Default: the cell is fixed.
    #[serde(default)]
    pub volume_ramp: Option<VolumeRampSection>,
    /// Barostat: walks at constant pressure, in place of a volume ramp. Default: none.
    #[serde(default)]
    pub barostat: Option<BarostatSettings>,
    /// Number of unbiased steps at constant pressure that give V₀, before the first step of a walk with a barostat. 0: V₀
    /// is the volume of the seed structure.
    #[serde(default = "defaults::reference_steps")]
    pub reference_steps: u64,
    /// V/V₀ at which a walk with a barostat starts.
    #[serde(default = "defaults::start_volume")]
    pub start_volume: Positive,
    /// Bias on the cell of walks with a barostat. Default: none.
    #[serde(default)]
    pub cell_bias: Option<CellBiasSection>,
    /// Whether calmwalk removes the energy that an update of the mixture gives to a biased walk from its kinetic energy.
    #[serde(default)]
    pub remove_update_work: bool,
    /// Number of steps over which the norms in τ_r are averaged.
    #[serde(default = "defaults::bias_averaging_steps")]
    pub bias_averaging_steps: NonZeroU64,
    /// Number of biased steps from one that measures the norms in τ_r to the next. Those between need one gradient in place of two. Above 1
    /// for models in Python only.
    #[serde(default = "defaults::bias_norm_interval")]
    pub bias_norm_interval: NonZeroU64,
    /// Number of steps between two points of the trace, which shows temperature, pressure, grade and bias along a walk. 0: none.
    #[serde(default = "defaults::trace_interval")]
    pub trace_interval: u64,
    /// Number of steps between two frames of the trajectory of a walk that the store keeps. 0: none.
    #[serde(default)]
    pub trajectory_interval: u64,
    /// Skin of the neighbour list, Å.
    #[serde(default = "defaults::skin")]
    pub skin: Positive,
}

/// `[[walks]]`
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WalkGroupSection {
    /// Name, by which views and filters select the walks of the group.
    pub name: String,
    /// Filter of the seed structures that the group walks from, by `atoms`, `element` and `seed_structure`. Default: all.
    #[serde(default)]
    pub seed_structures: Option<String>,
    /// Temperatures of the thermostat, K. Default: `walk.temperature`.
    #[serde(default)]
    pub temperatures: Vec<Positive>,
    /// Volume ramps. Default: `walk.volume_ramp`.
    #[serde(default)]
    pub volume_ramps: Vec<VolumeRampSection>,
    /// Pressures, bar, in place of volume ramps. Default: that of `walk.barostat`.
    #[serde(default)]
    pub pressures: Vec<f64>,
    /// V/V₀ at which walks at constant pressure start. Default: `walk.start_volume`.
    #[serde(default)]
    pub start_volumes: Vec<Positive>,
    /// Whether the cell of walks at constant pressure is biased. Default: true if there is a table `walk.cell_bias`.
    #[serde(default)]
    pub cell_bias: Option<bool>,
    /// Scales τ of the uncertainty force. Default: `walk.tau`.
    #[serde(default)]
    pub tau_values: Vec<Positive>,
    /// Number of walks under each combination of conditions; they differ in their random numbers.
    #[serde(default = "defaults::repeats")]
    pub repeats: NonZeroU32,
}

/// `volume_ramp = { from, to }`
#[derive(Clone, Copy, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct VolumeRampSection {
    /// V/V₀ at the first biased step.
    pub from: Positive,
    /// V/V₀ at the last biased step.
    pub to: Positive,
}

/// `[walk.cell_bias]`
#[derive(Clone, Copy, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CellBiasSection {
    /// Stress B, GPa. Default: the bulk modulus of the model at the seed structure.
    pub stress_scale: Option<Positive>,
    /// Gain τ_s at the start.
    pub gain: Positive,
    /// Smallest and largest gain.
    pub gain_range: [Positive; 2],
    /// Number of biased steps after which the gain is adjusted.
    pub window: NonZeroU64,
    /// Drift of V/V₀ in a window below which the gain grows.
    pub min_drift: Positive,
    /// Drift of V/V₀ in a window above which the gain is halved.
    pub max_drift: Positive,
    /// Smallest and largest V/V₀.
    pub volume_range: [Positive; 2],
    /// Number of collected structures after which a walk can end at a boundary of the volume.
    pub end_after_collected: u32,
    /// Number of contacts with a boundary, within `window` steps, after which such a walk ends.
    pub end_after_contacts: NonZeroU32,
}

impl Default for CellBiasSection {
    fn default() -> Self {
        let paper = CellBiasSettings::default();
        Self {
            stress_scale: None,
            gain: defaults::positive(paper.gain),
            gain_range: paper.gain_range.map(defaults::positive),
            window: NonZeroU64::new(paper.window).expect("a default above 0"),
            min_drift: defaults::positive(paper.min_drift),
            max_drift: defaults::positive(paper.max_drift),
            volume_range: paper.volume_range.map(defaults::positive),
            end_after_collected: paper.collected_to_end,
            end_after_contacts: defaults::nonzero(paper.contacts_to_end),
        }
    }
}

impl CellBiasSection {
    /// What walks need of it.
    pub fn settings(&self) -> CellBiasSettings {
        CellBiasSettings {
            stress_scale: self.stress_scale.map(|stress| stress.get() / GPA_PER_EV_A3),
            gain: self.gain.get(),
            gain_range: self.gain_range.map(Positive::get),
            window: self.window.get(),
            min_drift: self.min_drift.get(),
            max_drift: self.max_drift.get(),
            volume_range: self.volume_range.map(Positive::get),
            collected_to_end: self.end_after_collected,
            contacts_to_end: self.end_after_contacts.get(),
        }
    }
}

impl Default for WalkGroupSection {
    fn default() -> Self {
        Self {
            name: String::new(),
            seed_structures: None,
            temperatures: Vec::new(),
            volume_ramps: Vec::new(),
            pressures: Vec::new(),
            start_volumes: Vec::new(),
            cell_bias: None,
            tau_values: Vec::new(),
            repeats: defaults::repeats(),
        }
    }
}
