//! The configuration of a campaign: one TOML file that denies unknown keys and validates itself.

mod changes;
mod check;
mod defaults;
#[cfg(test)]
mod demo;
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
mod python;
mod ranges;
mod refit;
mod schema;
mod sections;
mod stop;
mod walk;
mod warning;

use std::path::{Path, PathBuf};

use bridge::PythonSettings;
use calm::UpdateSettings;
use calm::rules::Positive;
use orchestrator::batch::CustomScheduler;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use store::{Location, StoreError};
use toml::Spanned;
use workers::labeller::LabelGuard;

pub use changes::{ConfigChange, Refused, changed_keys, compare, without_changeable};
pub use check::{wrong_barostat, wrong_thermostat};
#[cfg(test)]
pub use demo::demo_without_refit;
pub use document::{Document, FILL_IN};
pub use error::{ConfigError, location, location_of_offset, read_text, user_message};
pub use files::{PotentialConfig, PotentialKind};
pub use hints::KnownKeys;
pub use method::LabelMethod;
pub use notify::{NotifyEvent, NotifySection};
pub use python::PythonSection;
pub use ranges::{impossible, usual_range};
pub use refit::*;
pub use schema::schema_text;
pub use sections::*;
pub use stop::StopSection;
pub use walk::*;
pub use warning::Warning;

/// A whole campaign.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
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
    pub seed_structures: SeedStructuresSection,
    /// Dynamics and bias.
    pub walk: WalkSection,
    /// Groups of walks under several conditions. Without them, one walk starts from each seed structure.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub walks: Vec<WalkGroupSection>,
    /// When a structure is collected.
    pub collect: CollectSection,
    /// What keeps walks physical.
    #[serde(default)]
    pub guard: GuardSection,
    /// How collected structures are labelled.
    pub label: LabelSection,
    /// How the potential is trained anew while the campaign runs. Without it, the campaign keeps its potential.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refit: Option<RefitSection>,
    /// What the campaign may use up.
    #[serde(default)]
    pub budget: BudgetSection,
    /// What ends the campaign before its walks have made all their steps.
    #[serde(default)]
    pub stop: StopSection,
    /// Processes and rounds.
    #[serde(default)]
    pub run: RunSection,
    /// Notifications about events of the campaign.
    #[serde(default)]
    pub notify: NotifySection,
    /// A batch system other than Slurm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub launch: Option<LaunchSection>,
}

/// Placeholders for required keys that are missing or invalid, so that the rest can be checked.
const PLACEHOLDERS: &str = r#"
potential = { model = "-" }
calm = {}
seed_structures = { files = ["-"] }
walk = { temperature = 300.0, biased_steps = 1, tau = 1.0 }
collect = { criterion = { rule = "maximum_grade" }, update_target = { rule = "maximum_grade" } }
label = { method = { potential = { kind = "grace", file = "-" } } }
refit = { replay = ["-"], method = { command = { program = ["-"] } } }
"#;

/// A configuration as it was read.
pub struct Loaded {
    /// The configuration, its paths resolved.
    pub config: Config,
    /// Its text.
    pub text: String,
    /// Values that are probably not intended.
    pub warnings: Vec<Warning>,
}

impl Config {
    /// The program of each device of a model in Python; none for other models.
    pub fn python_settings(&self) -> Vec<PythonSettings> {
        let Some(python) = &self.potential.python else { return Vec::new() };
        let combined_gradients = self.walk.bias_norm_interval.get() > 1;
        let settings = python.settings(self.potential.model.get_ref(), self.potential.precision);
        settings.into_iter().map(|one| PythonSettings { combined_gradients, ..one }).collect()
    }

    /// Reads and validates a configuration. Paths in it are taken relative to its own directory.
    ///
    /// # Errors
    /// Everything that is wrong with it.
    pub fn load(path: &Path) -> Result<Loaded, ConfigError> {
        Self::read(path, read_text(path)?, |document| document.refuse_unfilled())
    }

    /// The same for the text of a file that is not written yet. Its values may have the mark of those to fill in.
    pub fn from_draft(path: &Path, text: String) -> Result<Loaded, ConfigError> {
        Self::read(path, text, |_| ())
    }

    fn read(
        path: &Path,
        text: String,
        last_check: impl FnOnce(&mut Document<'_>),
    ) -> Result<Loaded, ConfigError> {
        let mut document = Document::parse(path, &text)?;
        let config: Option<Self> = document.read(PLACEHOLDERS, &Self::known_keys());
        let warnings = document.check_ranges("walk");
        document.check_rules(|| config.as_ref().map(check::check).unwrap_or_default());
        last_check(&mut document);
        document.finish()?;
        // What could not be read was noted, and is an error.
        let mut config = config.ok_or_else(|| ConfigError::unreadable(path))?;
        config.resolve_paths(path.parent().unwrap_or(Path::new("")));
        config.label.scheduler = config.launch.as_ref().and_then(|launch| launch.custom.clone());
        Ok(Loaded { config, text, warnings })
    }

    /// Reads the `[label]` section alone, of a configuration that needs no other.
    pub fn load_label(path: &Path) -> Result<LabelSection, ConfigError> {
        #[derive(Deserialize)]
        struct LabelDocument {
            label: LabelSection,
            #[serde(default)]
            launch: Option<LaunchSection>,
        }
        let text = read_text(path)?;
        let mut document = Document::parse(path, &text)?;
        let labels: Option<LabelDocument> = document.read(PLACEHOLDERS, &Self::known_keys());
        document.check_ranges("walk");
        document.check_rules(|| {
            let of = |all: &LabelDocument| check::check_label(&all.label, all.launch.as_ref());
            labels.as_ref().map(of).unwrap_or_default()
        });
        document.refuse_unfilled();
        document.finish()?;
        let LabelDocument { mut label, launch } = labels.ok_or_else(|| ConfigError::unreadable(path))?;
        let directory = path.parent().unwrap_or(Path::new(""));
        label.method.paths().into_iter().for_each(|path| *path = directory.join(&*path));
        label.scheduler = launch.and_then(|launch| launch.custom);
        Ok(label)
    }

    /// Reads the `[potential]` section alone, of a configuration that needs no other.
    pub fn load_potential(path: &Path) -> Result<PotentialSection, ConfigError> {
        #[derive(Deserialize)]
        struct PotentialDocument {
            potential: PotentialSection,
        }
        let text = read_text(path)?;
        let mut document = Document::parse(path, &text)?;
        let read: Option<PotentialDocument> = document.read(PLACEHOLDERS, &Self::known_keys());
        document.check_ranges("walk");
        document.finish()?;
        let PotentialDocument { mut potential } = read.ok_or_else(|| ConfigError::unreadable(path))?;
        let directory = path.parent().unwrap_or(Path::new(""));
        *potential.model.get_mut() = directory.join(potential.model.get_ref());
        if let Some(python) = &mut potential.python {
            python.resolve_paths(directory);
        }
        Ok(potential)
    }

    /// The keys of each section.
    fn known_keys() -> KnownKeys {
        KnownKeys::new()
            .with::<CampaignSection>("campaign")
            .with::<PotentialSection>("potential")
            .with::<PythonSection>("potential.python")
            .with::<CalmSection>("calm")
            .with::<SeedStructuresSection>("seed_structures")
            .with::<WalkSection>("walk")
            .with::<WalkGroupSection>("walks")
            .with::<CollectSection>("collect")
            .with::<GuardSection>("guard")
            .with::<LabelSection>("label")
            .with::<LabelGuard>("label.guard")
            .with::<ReferenceCheckSection>("label.reference_check")
            .with::<BudgetSection>("budget")
            .with::<StopSection>("stop")
            .with::<RunSection>("run")
            .with::<NotifySection>("notify")
            .with::<LaunchSection>("launch")
            .with::<CustomScheduler>("launch.custom")
            .with::<RefitSection>("refit")
            .with::<NativeRefit>("refit.method.native")
            .with::<CommandRefit>("refit.method.command")
            .with::<TestSetSection>("refit.test_sets")
    }

    /// Where the campaign is kept, if `directory` is its directory.
    pub fn location(&self, directory: &Path) -> Result<Location, StoreError> {
        match &self.run.store {
            Some(url) => url.parse(),
            None => Ok(Location::from(directory)),
        }
    }

    /// Checks it as a whole; everything that is wrong.
    pub fn check(&self) -> Vec<error::InvalidValue> {
        check::check(self)
    }

    /// Every path in it.
    fn paths(&mut self) -> impl Iterator<Item = &mut PathBuf> {
        let optional = self.calm.artifact.iter_mut().chain(&mut self.calm.training_frames);
        let optional = optional.chain(&mut self.label.reference_check.structures);
        let others =
            [&mut self.potential.model].into_iter().chain(optional).chain(&mut self.seed_structures.files);
        let of_refit = self.refit.iter_mut().flat_map(RefitSection::files);
        others.map(Spanned::get_mut).chain(self.label.method.paths()).chain(of_refit)
    }

    fn resolve_paths(&mut self, directory: &Path) {
        self.paths().for_each(|path| *path = directory.join(&*path));
        if let Some(python) = &mut self.potential.python {
            python.resolve_paths(directory);
        }
        self.notify.resolve_paths(directory);
        if let Some(program) = self.refit.as_mut().and_then(RefitSection::program_path) {
            *program = directory.join(&*program).to_string_lossy().into_owned();
        }
    }

    /// The same without any path: a campaign depends on what is in files, not on where they are.
    pub fn without_paths(&self) -> Self {
        let mut config = self.clone();
        config.paths().for_each(PathBuf::clear);
        config.refit.as_mut().and_then(RefitSection::program_path).into_iter().for_each(String::clear);
        config
    }

    /// Label jobs of each structure that is collected: its own, and that of its control frame.
    pub fn labels_of_each(&self) -> u32 {
        1 + u32::from(self.campaign.control)
    }

    /// Most structures that may be collected from a seed structure with `walks` walks.
    pub fn max_structures_of(&self, walks: usize) -> u64 {
        let all = u64::from(self.collect.max_per_walk.get()).saturating_mul(walks as u64);
        self.collect.max_per_seed_structure.map_or(all, |most| all.min(most.get().into()))
    }

    /// Most structures that may be collected, each with all its labels.
    pub fn max_structures(&self) -> Option<u32> {
        Some(self.limit_of_structures()?.0)
    }

    /// The same with the key that says so.
    fn limit_of_structures(&self) -> Option<(u32, &'static str)> {
        let by_labels = self.budget.labels.map(|labels| labels.get() / self.labels_of_each());
        let total = self.collect.max_structures.map(|total| (total.get(), "collect.max_structures"));
        by_labels.map(|labels| (labels, "budget.labels")).into_iter().chain(total).min()
    }

    /// Time without a heartbeat after which a walker is replaced. A walker whose call waits for a model in Python sends none.
    pub fn walker_heartbeat_timeout(&self) -> std::time::Duration {
        let of_calls = self.potential.python.as_ref().map(PythonSection::longest_call);
        self.run.heartbeat_timeout.get().max(of_calls.unwrap_or_default())
    }

    /// The limits that the store holds labellers to.
    pub fn budget(&self) -> store::Budget {
        let BudgetSection { labels, core_hours, wall_time } = self.budget.clone();
        store::Budget {
            labels: labels.map(|labels| labels.get().into()),
            core_hours: core_hours.map(Positive::get),
            wall_hours: wall_time.map(|time| time.seconds() / 3600.0),
            structures_by: self.limit_of_structures().map(|(_, key)| key.to_owned()),
        }
    }

    /// What the update search needs.
    pub fn update_settings(&self) -> UpdateSettings {
        let CalmSection { covariance_update, alpha_values, .. } = self.calm.clone();
        UpdateSettings { covariance_update, alpha_values, stop: self.collect.update_target }
    }
}
