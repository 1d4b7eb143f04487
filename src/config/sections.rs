//! The sections of a configuration, with their keys.

use std::num::{NonZeroU32, NonZeroU64, NonZeroUsize};
use std::path::PathBuf;

use atoms::MinDistanceRule;
use calm::CollectionRule;
use calm::rules::{CovarianceUpdateKind, Fraction, Positive};
use dft::PassedEnvironment;
use monitor::reference_check::DifferenceBounds;
use orchestrator::batch::CustomScheduler;
use orchestrator::selector::{CampaignMode, OnForgetting, UpdateProtocol};
use potentials::grace::Precision;
use potentials::{WallSettings, ZblWindows};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use store::LowerStateRule;
use toml::Spanned;
use workers::labeller::{BatchSystem, ExecutionSettings, KeepDirectories, LabelBounds, LabelGuard};

use super::{LabelMethod, PythonSection, defaults};
use crate::duration::Duration;

/// `[campaign]`
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CampaignSection {
    /// `reproducible`: rounds of a fixed number of walks. `live`: walks do not wait for each other.
    pub mode: CampaignMode,
    /// Seed of all random numbers of the campaign.
    pub rng_seed: u64,
    /// Whether each biased walk that collected a structure is followed by its unbiased control walk.
    pub control: bool,
    /// Share of the assignments that control walks get while there are any. Applies to live mode; in reproducible mode, a
    /// round has as many control walks as biased ones.
    pub control_share: Fraction,
}

/// `[potential]`
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PotentialSection {
    /// File of the exported GRACE model (`kokkos.npz`), or with `[potential.python]` the model's file or directory for the adapter.
    #[schemars(with = "PathBuf")]
    pub model: Spanned<PathBuf>,
    /// Floating-point precision in which walkers evaluate the model.
    #[serde(default)]
    pub precision: Precision,
    /// A model that its own framework evaluates, in Python. Default: none; calmwalk evaluates the exported GRACE model.
    #[serde(default)]
    pub python: Option<PythonSection>,
}

/// `[calm]`
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CalmSection {
    /// File of the mixture with scatter matrices and counts (`gmm_artifacts.npz`). Default: the mixture in the
    /// model's file, which cannot be updated.
    #[serde(default)]
    #[schemars(with = "Option<PathBuf>")]
    pub artifact: Option<Spanned<PathBuf>>,
    /// File of the frames that the mixture was built from. calmwalk grades them again with each mixture.
    #[serde(default)]
    #[schemars(with = "Option<PathBuf>")]
    pub training_frames: Option<Spanned<PathBuf>>,
    /// Share of training atoms with γ > 1 under the current mixture, of all or of one element, above which the alarm is
    /// raised.
    #[serde(default = "defaults::forgetting_alarm")]
    pub forgetting_alarm: Fraction,
    /// Growth of the mean σ² of an element's training atoms above which the alarm is raised, for elements without
    /// training frames.
    #[serde(default = "defaults::max_mean_square_growth")]
    pub max_mean_square_growth: Positive,
    /// What happens when the alarm is raised.
    #[serde(default)]
    pub on_forgetting: OnForgetting,
    /// What happens to the mixture between seed structures.
    #[serde(default = "defaults::update")]
    pub update: UpdateProtocol,
    /// How a collected feature changes a component's covariance: `convex` or `additive`.
    #[serde(default)]
    pub covariance_update: CovarianceUpdateKind,
    /// Values of α that an update tries. Default: the paper's.
    #[serde(default)]
    pub alpha_values: Option<calm::rules::AlphaValues>,
}

/// `[seed_structures]`
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SeedStructuresSection {
    /// Extended XYZ or POSCAR files; each frame is a seed structure.
    #[schemars(with = "Vec<PathBuf>", length(min = 1))]
    pub files: Vec<Spanned<PathBuf>>,
    /// What to do with a structure that no walk can start from.
    #[serde(default)]
    pub on_invalid: OnInvalid,
    /// Smallest number of atoms: a periodic cell with fewer is repeated to a supercell. Default: cells stay as they are.
    #[serde(default)]
    pub min_atoms: Option<NonZeroUsize>,
    /// Smallest distance between opposite faces of the cell along periodic directions, Å: a smaller cell is repeated to a
    /// supercell. Default: cells stay as they are.
    #[serde(default)]
    pub min_height: Option<Positive>,
}

/// What happens to a seed structure that no walk can start from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum OnInvalid {
    /// It is left out and listed; the campaign runs with the others.
    #[default]
    Skip,
    /// The campaign is refused.
    Error,
}

/// `[collect]`
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CollectSection {
    /// Rule by which a walker sends a structure as a candidate.
    pub criterion: CollectionRule,
    /// Rule that an update of the mixture must meet: it takes the smallest α that does.
    pub update_target: calm::UpdateRule,
    /// Minimum number of steps between two collected structures of a walk.
    #[serde(default = "defaults::min_interval")]
    pub min_interval: u64,
    /// Minimum number of steps after a candidate that was declined or rejected.
    #[serde(default = "defaults::min_interval_after_decline")]
    pub min_interval_after_decline: NonZeroU64,
    /// Largest number of structures collected by one walk.
    #[serde(default = "defaults::max_per_walk")]
    pub max_per_walk: NonZeroU32,
    /// Largest number of structures collected by all walks of one seed structure.
    #[serde(default)]
    pub max_per_seed_structure: Option<NonZeroU32>,
    /// Largest number of structures collected by the campaign.
    #[serde(default)]
    pub max_structures: Option<NonZeroU32>,
    /// Smallest probability that the label of a structure completes, for the structure to be collected, in live mode. Default: no
    /// limit.
    #[serde(default)]
    pub min_completion_probability: Option<Fraction>,
    /// Space in the store for feature vectors of declined candidates, MB.
    #[serde(default = "defaults::declined_features")]
    pub declined_features_mb: u64,
}

/// `[guard]`
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct GuardSection {
    /// Rule for the shortest allowed distances between atoms.
    pub min_distances: MinDistanceRule,
    /// Switched ZBL repulsion at short range. Default: none.
    pub zbl: Option<ZblWindows>,
    /// Wall around clusters. Default: none.
    pub wall: Option<WallSection>,
    /// Largest γ_max of a structure that is collected. Default: no limit.
    pub max_grade: Option<Positive>,
    /// Highest allowed kinetic temperature, K.
    pub max_temperature: Positive,
    /// Whether a walk rolls back to a checkpoint when the guard rejects one configuration after the other. If not, it continues.
    pub rollback: bool,
    /// Number of rejected configurations in a row after which a walk rolls back to a checkpoint.
    pub max_consecutive_rejections: NonZeroU32,
    /// Number of rollbacks after which the walk ends.
    pub max_rollbacks: u32,
    /// Factor on τ at each rollback.
    pub tau_factor: Fraction,
    /// Number of steps between checkpoints.
    pub checkpoint_interval: NonZeroU64,
}

/// `guard.wall`
#[derive(Clone, Copy, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct WallSection {
    /// Distance of the wall from the atom that is farthest from the centre of mass of the seed structure, Å.
    pub margin: Positive,
    /// Stiffness, eV/Å².
    pub stiffness: Positive,
}

/// `[label]`
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LabelSection {
    /// What calculates the labels.
    pub method: LabelMethod,
    /// Name of the protocol, by which exports and imports select labels. Default: the name of the method.
    #[serde(default)]
    pub protocol: Option<String>,
    /// Number of labels that `run` calculates at the same time. 0: all labels come from `calmwalk label`.
    #[serde(default = "defaults::concurrency")]
    pub concurrency: usize,
    /// Time for which a label job is leased to a labeller.
    #[serde(default = "defaults::lease_timeout")]
    pub lease_timeout: Duration,
    /// Number of attempts after which a label has failed.
    #[serde(default = "defaults::max_attempts")]
    pub max_attempts: NonZeroU32,
    /// Largest force that a label may have, eV/Å.
    #[serde(default = "defaults::max_force")]
    pub max_force: Positive,
    /// Largest component of the stress that a label may have, eV/Å³.
    #[serde(default = "defaults::max_stress")]
    pub max_stress: Positive,
    /// Largest magnitude of the energy that a label may have, eV/atom.
    #[serde(default = "defaults::max_energy_per_atom")]
    pub max_energy_per_atom: Positive,
    /// Largest difference from the potential's energy that a label may have, eV/atom.
    #[serde(default = "defaults::max_energy_difference_per_atom")]
    pub max_energy_difference_per_atom: Positive,
    /// Difference in energy above which two results for a structure are different magnetic states, eV/atom.
    #[serde(default = "defaults::min_state_difference")]
    pub min_state_difference: Positive,
    /// What to do when a result has a lower energy than the label by more than `min_state_difference`.
    #[serde(default)]
    pub on_lower_state: LowerStatePolicy,
    /// Number of cores of one calculation.
    #[serde(default = "defaults::cores")]
    pub cores: NonZeroU32,
    /// Number of GPUs of one calculation.
    #[serde(default)]
    pub gpus: u32,
    /// Time after which calmwalk ends a calculation.
    #[serde(default = "defaults::time_limit")]
    pub time_limit: Duration,
    /// Memory limit of one calculation, GB.
    pub memory: Option<Positive>,
    /// Directory in which calculations get directories of their own. Default: that of temporary files.
    pub scratch: Option<PathBuf>,
    /// Of which calculations the store keeps the directory.
    #[serde(default)]
    pub keep_directories: KeepDirectories,
    /// Environment variables that the program gets beside those that every program gets.
    #[serde(default)]
    pub pass_environment: PassedEnvironment,
    /// Batch system that runs each calculation as a job. Default: none; calculations run beside the labeller.
    pub batch_system: Option<BatchSystem>,
    /// Further options for Slurm.
    #[serde(default)]
    #[schemars(inner(regex(pattern = "^-")))]
    pub batch_options: Vec<String>,
    /// The batch system of `launch.custom`, for `batch_system = "custom"`.
    #[serde(skip)]
    pub scheduler: Option<CustomScheduler>,
    /// Order in which queued structures of equal priority are labelled.
    #[serde(default)]
    pub order: LabelOrder,
    /// Number of unfinished label jobs above which `on_queue_full` applies.
    #[serde(default = "defaults::queue_limit")]
    pub queue_limit: NonZeroU32,
    /// What happens above `queue_limit`.
    #[serde(default)]
    pub on_queue_full: QueueFull,
    /// Checks of a structure before it is labelled.
    #[serde(default)]
    pub guard: LabelGuard,
    /// Comparison of labels with known ones before the first walk starts.
    #[serde(default)]
    pub reference_check: ReferenceCheckSection,
}

/// `[label.reference_check]`
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ReferenceCheckSection {
    /// Extended XYZ file of structures with energy, forces and, where known, stress by the reference that the potential was
    /// trained on. Default: no check.
    #[schemars(with = "Option<PathBuf>")]
    pub structures: Option<Spanned<PathBuf>>,
    /// Largest difference in energy, after the offsets of the elements are fitted, eV/atom.
    pub max_energy_difference: Positive,
    /// Largest length of the difference of an atom's force, eV/Å.
    pub max_force_difference: Positive,
    /// Largest difference of a component of the stress, eV/Å³.
    pub max_stress_difference: Positive,
}

/// Order in which queued structures of equal priority are labelled.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum LabelOrder {
    /// In the order in which they were found.
    #[default]
    Found,
    /// By the value of their labels: expected error × probability of completion ÷ cost, where structures unlike those with
    /// labels are worth more.
    Value,
}

/// What happens while the label queue is longer than `queue_limit`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum QueueFull {
    /// Walkers wait.
    #[default]
    Wait,
    /// The threshold of the collection rule is raised; walkers wait at twice the limit.
    Raise,
}

/// What happens when a result for a structure is a lower state than its label.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum LowerStatePolicy {
    /// It is proposed; the user decides.
    #[default]
    Propose,
    /// It becomes the label.
    Supersede,
}

/// `[launch]`
#[derive(Clone, Debug, Default, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LaunchSection {
    /// The batch system of `calmwalk launch --on custom` and of `label.batch_system = "custom"`.
    pub custom: Option<CustomScheduler>,
}

/// `[budget]`
#[derive(Clone, Debug, Default, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BudgetSection {
    /// Largest number of labels.
    pub labels: Option<NonZeroU32>,
    /// Largest sum of core-hours of all attempts to label.
    pub core_hours: Option<Positive>,
    /// Longest time that the campaign runs.
    pub wall_time: Option<Duration>,
}

/// `[run]`
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RunSection {
    /// Number of walkers. 0: as many as the processor cores allow.
    pub walkers: usize,
    /// Number of threads of each walker.
    pub threads_per_walker: NonZeroUsize,
    /// Time without heartbeat after which a process is killed and replaced.
    pub heartbeat_timeout: Duration,
    /// Time without heartbeat after which an agent's walks go to other hosts.
    pub agent_heartbeat_timeout: Duration,
    /// Number of restarts without a result between them after which a process is not started again.
    pub max_restarts: u32,
    /// Number of biased walks that advance together (reproducible mode).
    pub walks_per_round: NonZeroUsize,
    /// Number of steps that a walker makes before it reports to the selector.
    pub steps_per_assignment: NonZeroU64,
    /// URL of a PostgreSQL database, without password. Default: SQLite in the campaign's directory.
    pub store: Option<String>,
}

impl LabelSection {
    /// Name of the protocol.
    pub fn protocol_name(&self) -> &str {
        self.protocol.as_deref().unwrap_or(self.method.name())
    }

    /// Bounds beyond which a label is rejected.
    pub fn bounds(&self) -> LabelBounds {
        LabelBounds {
            max_force: self.max_force.get(),
            max_stress: self.max_stress.get(),
            max_energy_per_atom: self.max_energy_per_atom.get(),
            max_energy_difference_per_atom: self.max_energy_difference_per_atom.get(),
        }
    }

    /// The rule for two states of a structure that the store applies.
    pub fn lower_state_rule(&self) -> LowerStateRule {
        let on_lower_state = match self.on_lower_state {
            LowerStatePolicy::Propose => store::OnLowerState::Propose,
            LowerStatePolicy::Supersede => store::OnLowerState::Supersede,
        };
        LowerStateRule { min_difference: self.min_state_difference.get(), on_lower_state }
    }

    /// How programs that calculate labels are run.
    pub fn execution_settings(&self) -> ExecutionSettings {
        let is_custom = self.batch_system == Some(BatchSystem::Custom);
        ExecutionSettings {
            cores: self.cores.get(),
            gpus: self.gpus,
            time_limit: self.time_limit.seconds(),
            memory: self.memory.map(Positive::get),
            scratch: self.scratch.clone(),
            keep: self.keep_directories,
            pass_environment: self.pass_environment.clone(),
            batch_system: self.batch_system,
            batch_options: self.batch_options.clone(),
            scheduler: self.scheduler.clone().filter(|_| is_custom).map(Box::new),
        }
    }
}

impl ReferenceCheckSection {
    /// The largest differences.
    pub fn bounds(&self) -> DifferenceBounds {
        DifferenceBounds {
            energy: self.max_energy_difference.get(),
            force: self.max_force_difference.get(),
            stress: self.max_stress_difference.get(),
        }
    }
}

impl Default for ReferenceCheckSection {
    fn default() -> Self {
        Self {
            structures: None,
            max_energy_difference: defaults::positive(0.005),
            max_force_difference: defaults::positive(0.05),
            max_stress_difference: defaults::positive(0.005),
        }
    }
}

impl Default for CampaignSection {
    fn default() -> Self {
        Self {
            mode: CampaignMode::Reproducible,
            rng_seed: 1,
            control: true,
            control_share: defaults::fraction(0.5),
        }
    }
}

impl Default for WallSection {
    fn default() -> Self {
        let WallSettings { margin, stiffness } = WallSettings::default();
        Self { margin: defaults::positive(margin), stiffness: defaults::positive(stiffness) }
    }
}

impl WallSection {
    /// What walks need of it.
    pub fn settings(&self) -> WallSettings {
        WallSettings { margin: self.margin.get(), stiffness: self.stiffness.get() }
    }
}

impl Default for GuardSection {
    fn default() -> Self {
        Self {
            min_distances: MinDistanceRule::default(),
            zbl: None,
            wall: None,
            max_grade: None,
            max_temperature: defaults::positive(20_000.0),
            rollback: true,
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
