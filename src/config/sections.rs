//! The sections of a configuration, with their keys.

use std::num::{NonZeroU32, NonZeroU64, NonZeroUsize};
use std::path::PathBuf;

use calm::CollectionRule;
use calm::rules::{CovarianceUpdateKind, Fraction, Positive};
use dft::PassedEnvironment;
use orchestrator::selector::{Mode, UpdateProtocol};
use potentials::grace::Precision;
use serde::{Deserialize, Serialize};
use toml::Spanned;
use workers::labeller::{BatchSystem, ExecutionSettings, KeepDirectories, LabelBounds, LabelGuard};
use workers::settings::ThermostatKind;

use super::{LabelMethod, defaults};
use crate::duration::Duration;

/// `[campaign]`
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct CampaignSection {
    /// Reproducible or live.
    pub mode: Mode,
    /// Random seed of all walks.
    pub rng_seed: u64,
    /// Whether biased walks that collected something are followed by their unbiased control.
    pub control: bool,
}

/// `[potential]`
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct PotentialSection {
    /// The exported model, `kokkos.npz`.
    pub model: Spanned<PathBuf>,
    /// In which walkers evaluate it.
    #[serde(default)]
    pub precision: Precision,
}

/// `[calm]`
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct CalmSection {
    /// `gmm_artifacts.npz` with scatter and counts; left out, the mixture that the model was exported with, which
    /// cannot be updated.
    #[serde(default)]
    pub artifact: Option<Spanned<PathBuf>>,
    /// The frames the mixture was built from, whose grades are watched under the live mixture.
    #[serde(default)]
    pub training_frames: Option<Spanned<PathBuf>>,
    /// Alarm when more than this share of the training atoms has γ > 1 under the live mixture.
    #[serde(default = "defaults::forgetting_alarm")]
    pub forgetting_alarm: Fraction,
    /// Carried, restarted or never.
    #[serde(default = "defaults::update")]
    pub update: UpdateProtocol,
    /// Convex or additive.
    #[serde(default)]
    pub covariance_update: CovarianceUpdateKind,
    /// The α to try; left out, those of the paper.
    #[serde(default)]
    pub alpha_values: Option<calm::rules::AlphaValues>,
}

/// `[seed_structures]`
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct SeedStructuresSection {
    /// extended XYZ or POSCAR files; every frame is a seed structure.
    pub files: Vec<Spanned<PathBuf>>,
}

/// `[walk]`
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct WalkSection {
    /// K.
    pub temperature: Positive,
    /// Biased steps.
    pub biased_steps: NonZeroU64,
    /// Unbiased steps before them.
    #[serde(default = "defaults::equilibration_steps")]
    pub equilibration_steps: u64,
    /// Uncertainty-force scale τ.
    pub tau: Positive,
    /// fs; left out, 2 fs, or 0.5 fs with H, He, Li or Be.
    #[serde(default)]
    pub time_step: Option<Positive>,
    /// Langevin or Nosé–Hoover.
    #[serde(default = "defaults::thermostat")]
    pub thermostat: ThermostatKind,
    /// Linear volume ramp over the biased steps; left out, the cell is fixed.
    #[serde(default)]
    pub volume_ramp: Option<VolumeRampSection>,
    /// Steps over which the norms of τ_r are averaged.
    #[serde(default = "defaults::bias_averaging_steps")]
    pub bias_averaging_steps: NonZeroU64,
    /// Skin of the neighbour list, Å.
    #[serde(default = "defaults::skin")]
    pub skin: Positive,
}

/// `volume_ramp = { from, to }`, V/V₀.
#[derive(Clone, Copy, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct VolumeRampSection {
    /// At the first biased step.
    pub from: Positive,
    /// At the last.
    pub to: Positive,
}

/// `[collect]`
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct CollectSection {
    /// When a structure is a candidate.
    pub criterion: CollectionRule,
    /// When an update has done enough.
    pub update_target: calm::UpdateRule,
    /// Least steps between two collections of a walk.
    #[serde(default = "defaults::min_interval")]
    pub min_interval: u64,
    /// Least steps after a candidate that was declined or refused.
    #[serde(default = "defaults::min_interval_after_decline")]
    pub min_interval_after_decline: NonZeroU64,
    /// Most structures from one seed structure.
    #[serde(default = "defaults::max_per_seed_structure")]
    pub max_per_seed_structure: NonZeroU32,
    /// Most structures in the campaign.
    #[serde(default)]
    pub max_structures: Option<NonZeroU32>,
    /// MB of feature vectors of declined candidates that are kept.
    #[serde(default = "defaults::declined_features")]
    pub declined_features_mb: u64,
}

/// `[guard]`
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct GuardSection {
    /// Å.
    pub min_distance: Positive,
    /// Of the seed structure's shortest distance.
    pub min_distance_fraction: Fraction,
    /// Switched ZBL repulsion.
    pub zbl: Option<ZblSection>,
    /// K.
    pub max_temperature: Positive,
    /// Refusals in a row after which a walk goes back.
    pub max_consecutive_rejections: NonZeroU32,
    /// Returns after which it ends.
    pub max_rollbacks: u32,
    /// Factor on τ at each return.
    pub tau_factor: Fraction,
    /// Steps between checkpoints to go back to.
    pub checkpoint_interval: NonZeroU64,
}

/// `zbl = { inner, outer }`, Å.
#[derive(Clone, Copy, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ZblSection {
    /// Full strength below.
    pub inner: Positive,
    /// Nothing beyond.
    pub outer: Positive,
}

/// `[label]`
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct LabelSection {
    /// The method.
    pub method: LabelMethod,
    /// Name of the protocol, as exports and imports call it; left out, that of the method.
    #[serde(default)]
    pub protocol: Option<String>,
    /// Labels calculated side by side by `run`; 0: all come from `calmwalk label`.
    #[serde(default = "defaults::concurrency")]
    pub concurrency: usize,
    /// How long a label job is leased to a labeller.
    #[serde(default = "defaults::lease_timeout")]
    pub lease_timeout: Duration,
    /// Attempts before a label counts as failed.
    #[serde(default = "defaults::max_attempts")]
    pub max_attempts: NonZeroU32,
    /// Largest force that is believed, eV/Å.
    #[serde(default = "defaults::max_force")]
    pub max_force: Positive,
    /// Largest component of a stress that is believed, eV/Å³.
    #[serde(default = "defaults::max_stress")]
    pub max_stress: Positive,
    /// Largest energy that is believed, whatever its sign, eV an atom.
    #[serde(default = "defaults::max_energy_per_atom")]
    pub max_energy_per_atom: Positive,
    /// Largest difference from the potential's energy that is believed, eV an atom.
    #[serde(default = "defaults::max_energy_difference_per_atom")]
    pub max_energy_difference_per_atom: Positive,
    /// Cores of a calculation by another program.
    #[serde(default = "defaults::cores")]
    pub cores: NonZeroU32,
    /// Longest time of a calculation.
    #[serde(default = "defaults::time_limit")]
    pub time_limit: Duration,
    /// Most memory of a calculation, GB.
    pub memory: Option<Positive>,
    /// Where calculations have their directories, if not where temporary files are.
    pub scratch: Option<PathBuf>,
    /// Which of these directories are kept in the store.
    #[serde(default)]
    pub keep_directories: KeepDirectories,
    /// Variables of the labeller's environment that its program gets beside those that every program gets.
    #[serde(default)]
    pub pass_environment: PassedEnvironment,
    /// The batch system that each calculation is a job of; left out, they run beside the labeller.
    pub batch_system: Option<BatchSystem>,
    /// Further options of its jobs.
    #[serde(default)]
    pub batch_options: Vec<String>,
    /// Walkers wait while more jobs than this are unfinished, or the threshold is raised.
    #[serde(default = "defaults::queue_limit")]
    pub queue_limit: NonZeroU32,
    /// Which of the two.
    #[serde(default)]
    pub on_queue_full: QueueFull,
    /// What a structure must be before anything is spent on its label.
    #[serde(default)]
    pub guard: LabelGuard,
}

/// What happens while the label queue is longer than it should be.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum QueueFull {
    /// Walkers wait.
    #[default]
    Wait,
    /// The threshold of the collection rule is raised; walkers wait at twice the limit.
    Raise,
}

/// `[budget]`
#[derive(Clone, Debug, Default, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct BudgetSection {
    /// Most labels that are made.
    pub labels: Option<NonZeroU32>,
    /// Most hours of label attempts.
    pub core_hours: Option<Positive>,
    /// Most hours for which it is under way.
    pub wall_hours: Option<Positive>,
}

/// `[run]`
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct RunSection {
    /// Walkers side by side; 0 for as many as the processor cores allow.
    pub walkers: usize,
    /// Threads of each.
    pub threads_per_walker: NonZeroUsize,
    /// A process that sends no heartbeat for this long hangs, and is replaced.
    pub heartbeat_timeout: Duration,
    /// An agent on another host that sends no heartbeat for this long is dead: its walks go to others.
    pub agent_heartbeat_timeout: Duration,
    /// Starts of a process in a row after failures, with nothing delivered between them; then it is given up.
    pub max_restarts: u32,
    /// Biased walks that advance together (reproducible mode).
    pub walks_per_round: NonZeroUsize,
    /// Steps of a turn.
    pub steps_per_assignment: NonZeroU64,
    /// URL of a PostgreSQL database, without password; left out, SQLite in the campaign's directory.
    pub store: Option<String>,
}

impl LabelSection {
    /// Name of the protocol.
    pub fn protocol_name(&self) -> &str {
        self.protocol.as_deref().unwrap_or(self.method.name())
    }

    /// What is believed of a label.
    pub fn bounds(&self) -> LabelBounds {
        LabelBounds {
            max_force: self.max_force.get(),
            max_stress: self.max_stress.get(),
            max_energy_per_atom: self.max_energy_per_atom.get(),
            max_energy_difference_per_atom: self.max_energy_difference_per_atom.get(),
        }
    }

    /// How the calculations of a program run.
    pub fn running(&self) -> ExecutionSettings {
        ExecutionSettings {
            cores: self.cores.get(),
            time_limit: self.time_limit.seconds(),
            memory: self.memory.map(Positive::get),
            scratch: self.scratch.clone(),
            keep: self.keep_directories,
            pass_environment: self.pass_environment.clone(),
            batch_system: self.batch_system,
            batch_options: self.batch_options.clone(),
        }
    }
}

impl Default for CampaignSection {
    fn default() -> Self {
        Self { mode: Mode::Reproducible, rng_seed: 1, control: true }
    }
}

impl Default for GuardSection {
    fn default() -> Self {
        Self {
            min_distance: defaults::positive(1.2),
            min_distance_fraction: defaults::fraction(0.75),
            zbl: None,
            max_temperature: defaults::positive(20_000.0),
            max_consecutive_rejections: defaults::nonzero(10),
            max_rollbacks: 3,
            tau_factor: defaults::fraction(0.5),
            checkpoint_interval: defaults::nonzero(100).into(),
        }
    }
}

impl Default for RunSection {
    fn default() -> Self {
        Self {
            walkers: 0,
            threads_per_walker: NonZeroUsize::MIN,
            heartbeat_timeout: Duration::from_seconds(120),
            agent_heartbeat_timeout: Duration::from_seconds(60),
            max_restarts: 5,
            walks_per_round: NonZeroUsize::MIN,
            steps_per_assignment: defaults::nonzero(250).into(),
            store: None,
        }
    }
}
