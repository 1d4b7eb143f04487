//! The configuration of a campaign: one TOML file that denies unknown keys and validates itself.

mod changes;
mod check;
mod document;
#[cfg(test)]
mod documented;
mod error;
mod files;
mod hints;
mod method;
#[cfg(test)]
mod mutated;
mod notify;
mod ranges;
mod warning;

use std::num::{NonZeroU32, NonZeroU64, NonZeroUsize};
use std::path::{Path, PathBuf};

use calm::rules::{CovarianceUpdateKind, Fraction, Positive};
use calm::{CollectionRule, UpdateSettings};
use dft::PassedEnvironment;
use orchestrator::selector::{Mode, UpdateProtocol};
use potentials::grace::Precision;
use serde::{Deserialize, Serialize};
use store::{Location, StoreError};
use toml::Spanned;
use workers::labeller::{BatchSystem, ExecutionSettings, KeepDirectories, LabelBounds, LabelGuard};
use workers::settings::ThermostatKind;

pub use changes::{Change, Refused, changed_keys, compare, without_changeable};
pub use document::Document;
pub use error::{ConfigError, in_plain_words, place, place_of_offset, read_text};
pub use files::{PotentialFile, PotentialKind};
pub use hints::{KnownKeys, nearest};
pub use method::LabelMethod;
pub use notify::{NotifyEvent, NotifySection};
pub use ranges::impossible;
pub use warning::Warning;

/// A whole campaign.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Mode and random seed.
    #[serde(default)]
    pub campaign: CampaignSection,
    /// The GRACE model that drives the walks.
    pub potential: PotentialSection,
    /// Its CALM mixture.
    pub calm: CalmSection,
    /// Where walks start.
    pub seeds: SeedsSection,
    /// Dynamics and bias.
    pub walk: WalkSection,
    /// When a structure is collected.
    pub collect: CollectSection,
    /// What keeps walks physical.
    #[serde(default)]
    pub guard: GuardSection,
    /// How collected structures are labelled.
    pub label: LabelSection,
    /// What the campaign may use up.
    #[serde(default)]
    pub budget: BudgetSection,
    /// Processes and rounds.
    #[serde(default)]
    pub run: RunSection,
    /// Who is told what happens.
    #[serde(default)]
    pub notify: NotifySection,
}

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
    pub combination: CovarianceUpdateKind,
    /// The α to try; left out, those of the paper.
    #[serde(default)]
    pub ladder: Option<calm::rules::AlphaValues>,
}

/// `[seeds]`
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct SeedsSection {
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
    pub steps: NonZeroU64,
    /// Unbiased steps before them.
    #[serde(default = "defaults::equilibration")]
    pub equilibration: u64,
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
    #[serde(default = "defaults::average_steps")]
    pub average_steps: NonZeroU64,
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
    pub when: CollectionRule,
    /// When an update has done enough.
    pub until: calm::UpdateRule,
    /// Least steps between two collections of a walk.
    #[serde(default = "defaults::gap")]
    pub gap: u64,
    /// Least steps after a candidate that was declined or refused.
    #[serde(default = "defaults::declined_gap")]
    pub declined_gap: NonZeroU64,
    /// Most structures from one seed structure.
    #[serde(default = "defaults::per_seed")]
    pub per_seed: NonZeroU32,
    /// Most structures in the campaign.
    #[serde(default)]
    pub total: Option<NonZeroU32>,
    /// MB of feature vectors of declined candidates that are kept.
    #[serde(default = "defaults::declined_features")]
    pub declined_features_mb: u64,
}

/// `[guard]`
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct GuardSection {
    /// Å.
    pub least_distance: Positive,
    /// Of the seed structure's shortest distance.
    pub least_distance_fraction: Fraction,
    /// Switched ZBL repulsion.
    pub zbl: Option<ZblSection>,
    /// K.
    pub highest_temperature: Positive,
    /// Refusals in a row after which a walk goes back.
    pub refusals_in_a_row: NonZeroU32,
    /// Returns after which it ends.
    pub most_returns: u32,
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
    #[serde(default = "defaults::slots")]
    pub slots: usize,
    /// How long a job is leased to a labeller, s.
    #[serde(default = "defaults::lease")]
    pub lease: NonZeroU32,
    /// Attempts before a label counts as failed.
    #[serde(default = "defaults::attempts")]
    pub attempts: NonZeroU32,
    /// Largest force that is believed, eV/Å.
    #[serde(default = "defaults::largest_force")]
    pub largest_force: Positive,
    /// Largest component of a stress that is believed, eV/Å³.
    #[serde(default = "defaults::largest_stress")]
    pub largest_stress: Positive,
    /// Largest energy that is believed, whatever its sign, eV an atom.
    #[serde(default = "defaults::largest_energy")]
    pub largest_energy: Positive,
    /// Largest difference from the potential's energy that is believed, eV an atom.
    #[serde(default = "defaults::largest_energy_difference")]
    pub largest_energy_difference: Positive,
    /// Cores of a calculation by another program.
    #[serde(default = "defaults::cores")]
    pub cores: NonZeroU32,
    /// Longest time of a calculation, s.
    #[serde(default = "defaults::time_limit")]
    pub time_limit: Positive,
    /// Most memory of a calculation, GB.
    pub memory: Option<Positive>,
    /// Where calculations have their directories, if not where temporary files are.
    pub scratch: Option<PathBuf>,
    /// Which of these directories are kept in the store.
    #[serde(default)]
    pub keep: KeepDirectories,
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
    pub queue_full: QueueFull,
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
    pub threads: NonZeroUsize,
    /// A process that gives no sign of life for so long is hung and replaced, s.
    pub silence_limit: Positive,
    /// An agent on another host that gives no sign of life for so long is taken for dead: its walks go to others, s.
    pub agent_silence_limit: Positive,
    /// Starts of a process in a row after failures, with nothing delivered between them; then it is given up.
    pub restarts: u32,
    /// Biased walks that advance together (reproducible mode).
    pub walks_per_round: NonZeroUsize,
    /// Steps of a turn.
    pub turn_steps: NonZeroU64,
    /// URL of a PostgreSQL database, without password; left out, SQLite in the campaign's directory.
    pub store: Option<String>,
}

/// Values that stand in for keys that must be there and are wrong, so that the rest can be read.
const STAND_INS: &str = r#"
potential = { model = "-" }
calm = {}
seeds = { files = ["-"] }
walk = { temperature = 300.0, steps = 1, tau = 1.0 }
collect = { when = { rule = "maximum_grade" }, until = { rule = "maximum_grade" } }
label = { method = { reference = { kind = "grace", file = "-" } } }
"#;

/// A configuration as it was read.
pub struct Loaded {
    /// The configuration, its paths resolved.
    pub config: Config,
    /// Its text.
    pub text: String,
    /// What is possible but hardly meant.
    pub warnings: Vec<Warning>,
}

impl Config {
    /// Reads and validates a configuration. Paths in it are taken relative to its own directory.
    ///
    /// # Errors
    /// Everything that is wrong with it.
    pub fn load(path: &Path) -> Result<Loaded, ConfigError> {
        let text = read_text(path)?;
        let mut document = Document::parse(path, &text)?;
        let config: Option<Self> = document.read(STAND_INS, &Self::known_keys());
        let warnings = document.check_ranges("walk");
        document.check_rules(|| config.as_ref().map(check::check).unwrap_or_default());
        document.finish()?;
        // What could not be read was noted, and is an error.
        let mut config = config.ok_or_else(|| ConfigError::unreadable(path))?;
        config.resolve_paths(path.parent().unwrap_or(Path::new("")));
        Ok(Loaded { config, text, warnings })
    }

    /// Reads the `[label]` section alone, of a configuration that needs no other.
    pub fn load_label(path: &Path) -> Result<LabelSection, ConfigError> {
        #[derive(Deserialize)]
        struct Labels {
            label: LabelSection,
        }
        let text = read_text(path)?;
        let mut document = Document::parse(path, &text)?;
        let labels: Option<Labels> = document.read(STAND_INS, &Self::known_keys());
        document.check_ranges("walk");
        document
            .check_rules(|| labels.as_ref().map(|all| check::check_label(&all.label)).unwrap_or_default());
        document.finish()?;
        let Labels { mut label } = labels.ok_or_else(|| ConfigError::unreadable(path))?;
        let directory = path.parent().unwrap_or(Path::new(""));
        label.method.paths().into_iter().for_each(|path| *path = directory.join(&*path));
        Ok(label)
    }

    /// The keys of each section.
    fn known_keys() -> KnownKeys {
        KnownKeys::new()
            .with::<CampaignSection>("campaign")
            .with::<PotentialSection>("potential")
            .with::<CalmSection>("calm")
            .with::<SeedsSection>("seeds")
            .with::<WalkSection>("walk")
            .with::<CollectSection>("collect")
            .with::<GuardSection>("guard")
            .with::<LabelSection>("label")
            .with::<LabelGuard>("label.guard")
            .with::<BudgetSection>("budget")
            .with::<RunSection>("run")
            .with::<NotifySection>("notify")
    }

    /// Where the campaign is kept, if `directory` is its directory.
    pub fn location(&self, directory: &Path) -> Result<Location, StoreError> {
        match &self.run.store {
            Some(url) => url.parse(),
            None => Ok(Location::from(directory)),
        }
    }

    /// Checks it as a whole; everything that is wrong.
    pub fn check(&self) -> Vec<check::Wrong> {
        check::check(self)
    }

    /// Every path in it.
    fn paths(&mut self) -> impl Iterator<Item = &mut PathBuf> {
        let optional = self.calm.artifact.iter_mut().chain(&mut self.calm.training_frames);
        let others = [&mut self.potential.model].into_iter().chain(optional).chain(&mut self.seeds.files);
        others.map(Spanned::get_mut).chain(self.label.method.paths())
    }

    fn resolve_paths(&mut self, directory: &Path) {
        self.paths().for_each(|path| *path = directory.join(&*path));
        self.notify.resolve_paths(directory);
    }

    /// The same without any path: a campaign depends on what is in files, not on where they are.
    pub fn without_paths(&self) -> Self {
        let mut config = self.clone();
        config.paths().for_each(PathBuf::clear);
        config
    }

    /// Label jobs of each structure that is collected: its own, and that of its control frame.
    pub fn labels_of_each(&self) -> u32 {
        1 + u32::from(self.campaign.control)
    }

    /// Most structures that may be collected, each with all its labels.
    pub fn most_structures(&self) -> Option<u32> {
        Some(self.limit_of_structures()?.0)
    }

    /// The same with the key that says so.
    fn limit_of_structures(&self) -> Option<(u32, &'static str)> {
        let by_labels = self.budget.labels.map(|labels| labels.get() / self.labels_of_each());
        let total = self.collect.total.map(|total| (total.get(), "collect.total"));
        by_labels.map(|labels| (labels, "budget.labels")).into_iter().chain(total).min()
    }

    /// The limits that the store holds labellers to.
    pub fn budget(&self) -> store::Budget {
        let BudgetSection { labels, core_hours, wall_hours } = self.budget.clone();
        store::Budget {
            labels: labels.map(|labels| labels.get().into()),
            core_hours: core_hours.map(Positive::get),
            wall_hours: wall_hours.map(Positive::get),
            structures_by: self.limit_of_structures().map(|(_, key)| key.to_owned()),
        }
    }

    /// What the update search needs.
    pub fn update_settings(&self) -> UpdateSettings {
        let (combination, ladder) = (self.calm.combination, self.calm.ladder.clone());
        UpdateSettings { combination, ladder, stop: self.collect.until }
    }
}

impl LabelSection {
    /// Name of the protocol.
    pub fn protocol_name(&self) -> &str {
        self.protocol.as_deref().unwrap_or(self.method.name())
    }

    /// What is believed of a label.
    pub fn bounds(&self) -> LabelBounds {
        LabelBounds {
            largest_force: self.largest_force.get(),
            largest_stress: self.largest_stress.get(),
            largest_energy: self.largest_energy.get(),
            largest_energy_difference: self.largest_energy_difference.get(),
        }
    }

    /// How the calculations of a program run.
    pub fn running(&self) -> ExecutionSettings {
        ExecutionSettings {
            cores: self.cores.get(),
            time_limit: self.time_limit.get(),
            memory: self.memory.map(Positive::get),
            scratch: self.scratch.clone(),
            keep: self.keep,
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
            least_distance: defaults::positive(1.2),
            least_distance_fraction: defaults::fraction(0.75),
            zbl: None,
            highest_temperature: defaults::positive(20_000.0),
            refusals_in_a_row: defaults::nonzero(10),
            most_returns: 3,
            tau_factor: defaults::fraction(0.5),
            checkpoint_interval: defaults::nonzero(100).into(),
        }
    }
}

impl Default for RunSection {
    fn default() -> Self {
        Self {
            walkers: 0,
            threads: NonZeroUsize::MIN,
            silence_limit: defaults::positive(120.0),
            agent_silence_limit: defaults::positive(60.0),
            restarts: 5,
            walks_per_round: NonZeroUsize::MIN,
            turn_steps: defaults::nonzero(250).into(),
            store: None,
        }
    }
}

/// Values of keys that are left out.
mod defaults {
    use super::*;

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

    pub fn lease() -> NonZeroU32 {
        nonzero(600)
    }

    /// As many as the longest ladder of remedies has steps.
    pub fn attempts() -> NonZeroU32 {
        nonzero(4)
    }

    pub fn cores() -> NonZeroU32 {
        nonzero(1)
    }

    pub fn time_limit() -> Positive {
        positive(86_400.0)
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
}
