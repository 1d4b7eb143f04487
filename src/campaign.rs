//! Loads and checks everything that a configuration names. `validate` stops there, and `run` starts with it.

mod agent_setup;
mod draft;
mod geometry;
mod known_structures;
mod load;
mod loader;
mod refit_files;
mod seed_structures;
mod short_range;
mod training_sample;
mod triage;
mod version;
mod walk_plan;
mod walk_time;

use std::num::NonZeroU32;
use std::path::{Path, PathBuf};

use atoms::{Repetition, Structure};
use calm::Artifact;
use calm::forgetting::ForgettingAlarm;
use monitor::reference_check::{self, KnownStructure};
use orchestrator::grader::Grader;
use orchestrator::selector::{CampaignMode, PotentialVersion, SelectorSettings, TrainingFrames};
use potentials::grace::Precision;
use serde_json::{Value, json};
use store::Protocol;
use wire::{CampaignId, ContentHash, MAX_KEPT_POINTS, WalkFrame};
use workers::settings::{GuardSettings, WalkSettings};

use crate::config::{Config, ConfigError, LabelMethod, Loaded, Warning, without_changeable};
use crate::exit_status::CommandError;
use crate::label_method::MethodConfig;
use crate::label_method::resolved_method;
use crate::loaded_model::LoadedModel;
use crate::output::log_and_warn;
use crate::versions::VersionOnDisk;
pub use draft::CampaignDraft;
use loader::Loader;
pub use seed_structures::{SkippedStructure, SourcedStructure};
pub use short_range::PairRange;
use short_range::pair_ranges;
pub use triage::{Remark, SeedStructureTriage, triage};
pub use walk_time::{StepTimes, WalkTime};

/// Keys that name files. The identity of a campaign includes the files' contents, not their paths.
const FILE_KEYS: [&str; 5] = [
    "/potential/model",
    "/calm/artifact",
    "/calm/training_frames",
    "/label/method/potential/file",
    "/refit/replay",
];

/// Number of supercells that are named.
const MAX_SHOWN_SUPERCELLS: usize = 5;

/// A campaign that is ready to run.
#[derive(Clone)]
pub struct LoadedCampaign {
    /// The configuration.
    pub config: Config,
    /// Path of the configuration file.
    pub path: PathBuf,
    /// Its text.
    pub text: String,
    /// The model.
    pub model: LoadedModel,
    /// The initial mixture.
    pub artifact: Artifact,
    /// Seed structures, in the order of the files.
    pub seed_structures: Vec<SourcedStructure>,
    /// Seed structures that no walk can start from.
    pub skipped: Vec<SkippedStructure>,
    /// The pairs of elements in the seed structures.
    pub pair_ranges: Vec<PairRange>,
    /// Features of the training frames, if the configuration names them.
    pub training: Option<TrainingFrames>,
    /// The label protocol.
    pub protocol: Protocol,
    /// The structures of `label.reference_check`.
    pub known: Vec<KnownStructure>,
    /// Name and hash of every file whose content must not change.
    pub file_hashes: Vec<(String, String)>,
    /// Settings that are valid but likely mistakes.
    pub warnings: Vec<Warning>,
    /// The version of the potential, if it is not that of the configuration. Model, mixture and training frames are its own.
    pub version: Option<VersionOnDisk>,
}

impl LoadedCampaign {
    /// Reads a configuration and every file that it names.
    ///
    /// # Errors
    /// Fails with all errors of the configuration, otherwise with the first error of each file key.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let Loaded { config, text, mut warnings } = Config::load(path)?;
        let loader = Loader { path, text: &text, config: &config };
        let model = loader.model()?;
        let grades = loader.artifact(&model).and_then(|artifact| {
            let training = loader.training_frames(&model, &artifact.mixture)?;
            Ok((artifact, training))
        });
        let labels = loader.seed_structures(&*model.shared()).and_then(|mut seeds| {
            let protocol = loader.protocol(&mut seeds)?;
            loader.check_wall(&seeds)?;
            warnings.extend(loader.plan_walks(&mut seeds)?);
            loader.check_update_target(&seeds.valid)?;
            Ok((seeds, protocol))
        });
        let ((artifact, training), (seeds, (protocol, mut file_hashes))) =
            combine_errors(path, grades, labels)?;
        warnings.extend(loader.suspicious_grades(&model, &artifact, &seeds.valid, training.as_ref())?);
        warnings.extend(loader.suspicious_seed_structures(&seeds));
        warnings.extend(loader.suspicious_held_out(&seeds.valid));
        let pair_ranges = pair_ranges(&config, &seeds.valid);
        warnings.extend(loader.repulsion_in_bonds(&pair_ranges));
        let (known, suspicious) = loader.known_structures(&model.shared())?;
        warnings.extend(suspicious);
        file_hashes.insert(0, loader.model_hash(&model)?);
        let others = [
            ("calm.artifact", &config.calm.artifact),
            ("calm.training_frames", &config.calm.training_frames),
        ];
        for (key, file) in others {
            file_hashes.extend(file.as_ref().map(|file| loader.hash(key, file)).transpose()?);
        }
        file_hashes.extend(loader.refit_files(&*model.shared())?);
        let path = path.to_owned();
        Ok(Self {
            config,
            path,
            text,
            model,
            artifact,
            skipped: seeds.skipped,
            seed_structures: seeds.valid,
            pair_ranges,
            training,
            protocol,
            known,
            file_hashes,
            warnings,
            version: None,
        })
    }

    /// Prints the warnings to standard error and logs them.
    pub fn print_warnings(&self) {
        self.warnings.iter().for_each(log_and_warn);
    }

    /// How labels are made.
    pub fn method(&self) -> Result<MethodConfig, CommandError> {
        MethodConfig::from_section(&self.config.label)
    }

    /// Size of the label of each seed structure, on which its cost depends. A program must be installed.
    pub fn label_sizes(&self) -> Result<Vec<dft::CalculationSize>, CommandError> {
        let structures = self.seed_structures.iter().map(|seed| &seed.plan.structure);
        Ok(match &self.config.label.method {
            LabelMethod::Potential(_) => structures
                .map(|structure| dft::CalculationSize { atoms: structure.len(), electrons: 0.0, k_points: 1 })
                .collect(),
            LabelMethod::Code(settings) => {
                let code = settings.prepare(&self.config.label.pass_environment);
                let code = code.map_err(|error| CommandError::Input(error.to_string()))?;
                structures.map(|structure| code.size(structure)).collect()
            }
        })
    }

    /// Paths of the files that determine grades, by configuration key.
    pub fn grade_files(&self) -> Value {
        let calm = &self.config.calm;
        let files = [
            ("potential.model", Some(&self.config.potential.model)),
            ("calm.artifact", calm.artifact.as_ref()),
            ("calm.training_frames", calm.training_frames.as_ref()),
        ];
        let absolute = |path: &PathBuf| std::path::absolute(path).unwrap_or_else(|_| path.clone());
        let files = files.into_iter().filter_map(|(key, file)| Some((key, absolute(file?.get_ref()))));
        files.map(|(key, path)| (key.to_owned(), json!(path.to_string_lossy()))).collect()
    }

    /// Hash of the file that the configuration names under this key.
    pub fn hash_of(&self, key: &str) -> String {
        let hashes = self.file_hashes.iter().find(|(name, _)| name == key);
        hashes.map(|(_, hash)| hash.clone()).unwrap_or_default()
    }

    /// The seed structure with most atoms.
    pub fn largest_seed_structure(&self) -> Option<&Structure> {
        self.seed_structures.iter().map(|seed| &seed.plan.structure).max_by_key(|structure| structure.len())
    }

    /// Size of the largest message between walker and selector, bytes: a candidate of the largest seed structure with
    /// the checkpoints of its walk (three states with velocities and forces), the points of its trace, and the frames of its trajectory.
    pub fn largest_message(&self) -> usize {
        let atoms = self.largest_seed_structure().map_or(0, Structure::len);
        let features = self.artifact.mixture.dimension();
        let interval = self.config.walk.trace_interval;
        let points = self.config.run.steps_per_assignment.get().checked_div(interval).unwrap_or(0);
        let points = points.min(MAX_KEPT_POINTS as u64) as usize + 2;
        let frames = match self.config.walk.trajectory_interval {
            0 => 0,
            _ => max_frames(&self.config) * WalkFrame::max_bytes(atoms),
        };
        8 * atoms * (9 + features) + 512 * atoms + 192 * points + frames + 16_384
    }

    /// The configuration with every default filled in, and with hashes instead of paths. A campaign that continues is
    /// compared with it.
    pub fn resolved(&self) -> Value {
        let mut value = serde_json::to_value(self.config.without_paths()).expect("plain data becomes JSON");
        for pointer in FILE_KEYS {
            if let Some(path) = value.pointer_mut(pointer) {
                *path = Value::Null;
            }
        }
        let hashes = self.file_hashes.iter().map(|(key, hash)| (key.clone(), json!(hash)));
        value["files"] = Value::Object(hashes.collect());
        value["label"]["protocol"] = json!(self.config.label.protocol_name());
        value["label"]["method"] = resolved_method(&self.config.label, &self.protocol);
        match value["potential"]["python"].as_object_mut() {
            // The hash of the model is one of its adapter, too.
            Some(python) => drop(python.remove("adapter")),
            None => drop(value["potential"].as_object_mut().map(|potential| potential.remove("python"))),
        }
        // Campaigns that began before this key existed have none.
        if self.config.potential.precision == Precision::Double {
            value["potential"].as_object_mut().map(|potential| potential.remove("precision"));
        }
        match self.known_hash() {
            Some(hash) => value["label"]["reference_check"]["structures"] = json!(hash),
            None => drop(value["label"].as_object_mut().map(|label| label.remove("reference_check"))),
        }
        // The location of the store is not part of the campaign's identity.
        value["run"].as_object_mut().map(|run| run.remove("store"));
        if self.config.campaign.mode == CampaignMode::Reproducible {
            value["instructions"] = json!(instructions());
        }
        let seed = |named: &SourcedStructure| {
            format!("{} {}", named.plan.name, ContentHash::from_structure(&named.plan.structure))
        };
        value["seed_structures"] = self.seed_structures.iter().map(seed).collect();
        value
    }

    /// Hash of the structures of `label.reference_check` and what is known of them; `None` without the check.
    fn known_hash(&self) -> Option<String> {
        (!self.known.is_empty()).then(|| reference_check::hash(&self.known).to_string())
    }

    /// Hash of everything that cannot change during a campaign, and of the initial seed structures.
    pub fn id(&self) -> CampaignId {
        let fixed = without_changeable(&self.resolved());
        let mut hasher = blake3::Hasher::new();
        hasher.update(b"calmwalk campaign 1");
        hasher.update(fixed.to_string().as_bytes());
        for named in &self.seed_structures {
            hasher.update(named.plan.name.as_bytes());
            hasher.update(&ContentHash::from_structure(&named.plan.structure).0);
        }
        let mut id = [0; 16];
        id.copy_from_slice(&hasher.finalize().as_bytes()[..16]);
        CampaignId(id)
    }

    /// Which seed structures are supercells of the cells in the files, if any.
    pub fn supercells(&self) -> Option<String> {
        let made: Vec<_> =
            self.seed_structures.iter().filter(|named| named.repetition != Repetition::ONE).collect();
        let shown =
            made.iter().take(MAX_SHOWN_SUPERCELLS).map(|SourcedStructure { plan, repetition, .. }| {
                format!("'{}' {repetition} ({} atoms)", plan.name, plan.structure.len())
            });
        let shown = shown.collect::<Vec<_>>().join(", ");
        let more = match made.len().saturating_sub(MAX_SHOWN_SUPERCELLS) {
            0 => String::new(),
            more => format!(" and {more} more"),
        };
        let all = self.seed_structures.len();
        (!made.is_empty()).then(|| format!("{} of {all} seed structures: {shown}{more}", made.len()))
    }

    /// The seed structures as stored.
    pub fn stored_seed_structures(&self) -> Vec<store::SeedStructure> {
        let stored = |(index, named): (usize, &SourcedStructure)| store::SeedStructure {
            index: index as u32,
            name: named.plan.name.clone(),
            source: named.source.clone(),
            structure: named.plan.structure.clone(),
        };
        self.seed_structures.iter().enumerate().map(stored).collect()
    }

    /// The part of the model that the orchestrator needs.
    pub fn grader(&self) -> Grader {
        grader(&self.model)
    }

    /// The part of the configuration that walks need.
    pub fn walk_settings(&self) -> WalkSettings {
        walk_settings(&self.config)
    }

    /// The part of the configuration that the selector needs.
    pub fn selector_settings(&self) -> SelectorSettings {
        let version = self.version.as_ref().map(|found| found.version.clone()).unwrap_or_default();
        SelectorSettings { version, ..selector_settings(&self.config) }
    }
}

/// Both values, or the errors of both.
fn combine_errors<A, B>(
    path: &Path,
    a: Result<A, ConfigError>,
    b: Result<B, ConfigError>,
) -> Result<(A, B), ConfigError> {
    match (a, b) {
        (Ok(a), Ok(b)) => Ok((a, b)),
        (Err(error), Ok(_)) | (Ok(_), Err(error)) => Err(error),
        (Err(a), Err(b)) => Err(ConfigError::Several { path: path.to_owned(), errors: vec![a, b] }),
    }
}

/// Loads what grades depend on: the model, the initial mixture, and the training frames if they are monitored. `name`
/// stands for the configuration in error messages.
pub fn load_for_grades(
    config: &Config,
    name: &Path,
) -> Result<(LoadedModel, Artifact, Option<TrainingFrames>), ConfigError> {
    let loader = Loader { path: name, text: "", config };
    let model = loader.model()?;
    let artifact = loader.artifact(&model)?;
    let training = loader.training_frames(&model, &artifact.mixture)?;
    Ok((model, artifact, training))
}

/// The part of the model that grades need.
pub fn grader(model: &LoadedModel) -> Grader {
    let model = model.shared();
    let n = model.elements().len();
    let cutoffs = (0..n * n).map(|k| model.pair_cutoff(k / n, k % n)).collect();
    Grader::new(model.elements().to_vec(), cutoffs)
}

/// Largest number of frames in a report.
const MAX_FRAMES: u64 = 64;

/// Largest number of frames in a report: those of an assignment without a roll back, up to a limit.
fn max_frames(config: &Config) -> usize {
    match config.run.steps_per_assignment.get().checked_div(config.walk.trajectory_interval) {
        Some(frames) => frames.saturating_add(2).min(MAX_FRAMES) as usize,
        None => 1,
    }
}

/// The part of a configuration that walks need.
pub fn walk_settings(config: &Config) -> WalkSettings {
    let Config { campaign, walk, collect, guard, .. } = config;
    WalkSettings {
        rng_seed: campaign.rng_seed,
        thermostat: walk.thermostat,
        time_step: walk.time_step.map(|dt| dt.get()),
        equilibration_steps: walk.equilibration_steps,
        biased_steps: walk.biased_steps.get(),
        bias_averaging_steps: walk.bias_averaging_steps.get(),
        bias_norm_interval: walk.bias_norm_interval.get(),
        barostat: walk.barostat.unwrap_or_default(),
        reference_steps: walk.reference_steps,
        cell_bias: walk.cell_bias.unwrap_or_default().settings(),
        trace_interval: walk.trace_interval,
        trajectory_interval: walk.trajectory_interval,
        max_frames: max_frames(config),
        remove_update_work: walk.remove_update_work,
        skin: walk.skin.get(),
        collection: collect.criterion,
        min_interval: collect.min_interval,
        min_interval_after_decline: collect.min_interval_after_decline.get(),
        zbl: guard.zbl.clone(),
        wall: guard.wall.map(|wall| wall.settings()),
        guard: GuardSettings {
            min_distances: guard.min_distances.clone(),
            max_grade: guard.max_grade.map(|grade| grade.get()),
            max_temperature: guard.max_temperature.get(),
            rollback: guard.rollback,
            max_consecutive_rejections: guard.max_consecutive_rejections.get(),
            max_rollbacks: guard.max_rollbacks,
            tau_factor: guard.tau_factor.get(),
            checkpoint_interval: guard.checkpoint_interval.get(),
        },
    }
}

/// The part of a configuration that the selector needs.
pub fn selector_settings(config: &Config) -> SelectorSettings {
    let Config { campaign, calm, collect, guard, run, .. } = config;
    SelectorSettings {
        mode: campaign.mode,
        walks_per_round: run.walks_per_round.get(),
        steps_per_assignment: run.steps_per_assignment.get(),
        update: calm.update,
        search: config.update_settings(),
        forgetting_alarm: ForgettingAlarm {
            share_above_one: calm.forgetting_alarm,
            mean_square_growth: calm.max_mean_square_growth,
        },
        on_forgetting: calm.on_forgetting,
        collection: collect.criterion,
        max_per_walk: collect.max_per_walk.get(),
        max_per_seed_structure: collect.max_per_seed_structure.map(NonZeroU32::get),
        max_structures: config.max_structures(),
        max_steps_without_structure: config.stop.max_steps_without_structure.map(u64::from),
        stop_groups: config.stop.walks.clone().unwrap_or_default(),
        control: campaign.control,
        control_share: campaign.control_share.get(),
        min_distances: guard.min_distances.clone(),
        max_grade: config.guard.max_grade.map(|grade| grade.get()),
        declined_feature_bytes: collect.declined_features_mb * 1_000_000,
        version: PotentialVersion::default(),
        refit_at: None,
    }
}

/// The instruction sets that the numerical libraries select from. Another set changes the last bits of results.
pub fn instructions() -> String {
    let mut names = vec![std::env::consts::ARCH];
    #[cfg(target_arch = "x86_64")]
    {
        let detected = [
            ("avx2", is_x86_feature_detected!("avx2")),
            ("fma", is_x86_feature_detected!("fma")),
            ("avx512f", is_x86_feature_detected!("avx512f")),
        ];
        names.extend(detected.iter().filter(|(_, there)| *there).map(|(name, _)| name));
    }
    names.join(" ")
}
