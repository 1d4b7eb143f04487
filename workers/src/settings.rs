//! Settings of walks.

use atoms::MinDistanceRule;
use md::BarostatSettings;
use potentials::{WallSettings, ZblWindows};
use serde::{Deserialize, Serialize};

use crate::cell_bias::CellBiasSettings;

/// Dynamics, bias and guards of every walk of a campaign. What differs between walks is in their conditions
/// ([`wire::WalkConditions`]).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct WalkSettings {
    /// Random seed.
    pub rng_seed: u64,
    /// Thermostat.
    pub thermostat: md::ThermostatSettings,
    /// Time step, fs; `None` for the paper's rule (2 fs; 0.5 fs with H, He, Li or Be).
    pub time_step: Option<f64>,
    /// Unbiased steps at the start, at the volume at which the walk starts.
    pub equilibration_steps: u64,
    /// Biased steps after equilibration.
    pub biased_steps: u64,
    /// Steps over which the two norms of τ_r are exponentially averaged.
    pub bias_averaging_steps: u64,
    /// Biased steps from one that measures these norms to the next; those between need one gradient only. Walks at constant pressure measure
    /// them at each step, since they need the virial without bias.
    pub bias_norm_interval: u64,
    /// Barostat of walks at constant pressure, whose pressure is in their conditions.
    pub barostat: BarostatSettings,
    /// Steps of the reference run of walks at constant pressure; 0 for none.
    pub reference_steps: u64,
    /// Bias on the cell of walks at constant pressure that have one.
    pub cell_bias: CellBiasSettings,
    /// Steps between two points of the trace; 0: none.
    pub trace_interval: u64,
    /// Steps between two frames of the trajectory; 0: none.
    pub trajectory_interval: u64,
    /// Largest number of frames in a report, 1 or more. An assignment with more is interrupted, and goes on after the report.
    pub max_frames: usize,
    /// Whether the energy that an update of the mixture gives to a biased walk is taken out of its kinetic energy.
    pub remove_update_work: bool,
    /// Neighbour-list skin, Å.
    pub skin: f64,
    /// When a structure becomes a candidate.
    pub collection: calm::CollectionRule,
    /// Minimum number of steps between two accepted structures of a walk.
    pub min_interval: u64,
    /// Minimum number of steps between two candidates after one that was declined or rejected.
    pub min_interval_after_decline: u64,
    /// Windows of the switched ZBL repulsion; `None` without one.
    pub zbl: Option<ZblWindows>,
    /// The wall around clusters; `None` without one.
    pub wall: Option<WallSettings>,
    /// Guards.
    pub guard: GuardSettings,
}

/// Settings of the guards.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GuardSettings {
    /// How close atoms may come.
    pub min_distances: MinDistanceRule,
    /// γ_max above which a structure is rejected; `None` for no bound.
    pub max_grade: Option<f64>,
    /// Temperature above which a walk ends, K.
    pub max_temperature: f64,
    /// Whether a walk rolls back to a checkpoint after rejections; if not, it continues.
    pub rollback: bool,
    /// Consecutive rejections, by any guard, after which the walk rolls back to a checkpoint.
    pub max_consecutive_rejections: u32,
    /// Number of roll backs after which the walk ends instead.
    pub max_rollbacks: u32,
    /// Factor on τ at each roll back.
    pub tau_factor: f64,
    /// Steps between checkpoints for roll backs.
    pub checkpoint_interval: u64,
}
