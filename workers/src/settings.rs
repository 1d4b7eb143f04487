//! What walks need to know of the configuration.

use serde::{Deserialize, Serialize};

/// The thermostat of a walk.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ThermostatKind {
    /// Langevin dynamics, BAOAB.
    Langevin {
        /// Friction, 1/fs.
        friction: f64,
    },
    /// Nosé–Hoover chain.
    NoseHoover {
        /// Relaxation time, fs.
        relaxation_time: f64,
        /// Thermostats in the chain.
        chain_length: usize,
    },
}

/// Dynamics, bias and guards of every walk of a campaign.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct WalkSettings {
    /// Keys the random numbers.
    pub rng_seed: u64,
    /// K.
    pub temperature: f64,
    /// Thermostat.
    pub thermostat: ThermostatKind,
    /// fs; `None` for the paper's rule (2 fs; 0.5 fs with H, He, Li or Be).
    pub time_step: Option<f64>,
    /// Unbiased steps at the start, at V₀.
    pub equilibration: u64,
    /// Biased steps after that.
    pub steps: u64,
    /// Uncertainty-force scale τ.
    pub tau: f64,
    /// Steps over which the two norms of τ_r are exponentially averaged.
    pub average_steps: u64,
    /// V/V₀ at the start and at the end of the biased steps; `None` for a fixed cell.
    pub volume_ramp: Option<(f64, f64)>,
    /// Neighbour-list skin, Å.
    pub skin: f64,
    /// When a structure is a candidate.
    pub collection: calm::CollectionRule,
    /// Least steps between two accepted structures of a walk.
    pub gap: u64,
    /// Least steps between two candidates after one that was declined or refused.
    pub declined_gap: u64,
    /// Switched ZBL repulsion: inner and outer radius of the switch, Å.
    pub zbl: Option<(f64, f64)>,
    /// Guards.
    pub guard: GuardSettings,
}

/// What keeps a walk physical.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GuardSettings {
    /// Shortest distance below which a structure is refused, Å.
    pub least_distance: f64,
    /// The same as a fraction of the seed structure's shortest distance; the larger of the two holds.
    pub least_distance_fraction: f64,
    /// A walk hotter than this ends, K.
    pub highest_temperature: f64,
    /// Refusals in a row by the same guard after which the walk goes back to a checkpoint.
    pub refusals_in_a_row: u32,
    /// Returns after which it ends instead.
    pub most_returns: u32,
    /// Factor on τ at each return.
    pub tau_factor: f64,
    /// Steps between the checkpoints that it may go back to.
    pub checkpoint_interval: u64,
}
