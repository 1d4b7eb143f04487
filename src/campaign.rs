//! Everything that a configuration names, loaded and checked: what `validate` does and `run` begins with.

mod load;
mod seeds;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use calm::Artifact;
use calm::watch::ForgettingAlarm;
use orchestrator::grader::Grader;
use orchestrator::selector::{self, Mode, SeedStructure, TrainingFrames};
use potentials::grace::{GraceModel, Precision};
use serde_json::{Value, json};
use store::Protocol;
use wire::{CampaignId, ContentHash};
use workers::settings::{GuardSettings, WalkSettings};

use crate::config::{Config, ConfigError, LabelMethod, Loaded, Warning, without_changeable};
use crate::labelling::resolved_method;
use crate::outcome::Failure;
use crate::output::warn;
use crate::setup::MethodSetup;
use load::Loader;
pub use load::check_sound;

/// Keys that name files: a campaign depends on what is in them, not on where they are.
const FILE_KEYS: [&str; 4] =
    ["/potential/model", "/calm/artifact", "/calm/training_frames", "/label/method/reference/file"];

/// A campaign ready to run.
pub struct Campaign {
    /// The configuration.
    pub config: Config,
    /// Where it is.
    pub path: PathBuf,
    /// Its text.
    pub text: String,
    /// The model.
    pub model: Arc<GraceModel>,
    /// Its mixture at the start.
    pub artifact: Artifact,
    /// Seed structures, in the order of the files.
    pub seeds: Vec<NamedSeed>,
    /// Features of the training frames, if the configuration names them.
    pub training: Option<TrainingFrames>,
    /// The label protocol.
    pub protocol: Protocol,
    /// Name and hash of every file whose content must not change.
    pub file_hashes: Vec<(String, String)>,
    /// What is possible but hardly meant.
    pub warnings: Vec<Warning>,
}

/// A seed structure and where it came from.
pub struct NamedSeed {
    /// Name and structure.
    pub seed: SeedStructure,
    /// `file:line`
    pub source: String,
}

impl Campaign {
    /// Reads a configuration and every file that it names.
    ///
    /// # Errors
    /// Everything that is wrong with the configuration; else what is wrong with the files, of each key the first.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let Loaded { config, text, mut warnings } = Config::load(path)?;
        let loader = Loader { path, text: &text, config: &config };
        let model = loader.model()?;
        let grades = loader.artifact(&model).and_then(|artifact| {
            let training = loader.training_frames(&model, &artifact.mixture)?;
            Ok((artifact, training))
        });
        let labels = loader.seeds(&model).and_then(|seeds| {
            let protocol = loader.protocol(&seeds)?;
            Ok((seeds, protocol))
        });
        let ((artifact, training), (seeds, (protocol, mut file_hashes))) = both(path, grades, labels)?;
        warnings.extend(loader.doubtful_grades(&model, &artifact, &seeds, training.as_ref())?);
        warnings.extend(loader.doubtful_seeds(&seeds, &model));
        file_hashes.insert(0, loader.hash("potential.model", &config.potential.model)?);
        let others = [
            ("calm.artifact", &config.calm.artifact),
            ("calm.training_frames", &config.calm.training_frames),
        ];
        for (key, file) in others {
            file_hashes.extend(file.as_ref().map(|file| loader.hash(key, file)).transpose()?);
        }
        let path = path.to_owned();
        Ok(Self { config, path, text, model, artifact, seeds, training, protocol, file_hashes, warnings })
    }

    /// Prints the warnings on the standard error and in the log.
    pub fn print_warnings(&self) {
        self.warnings.iter().for_each(warn);
    }

    /// How labels are made.
    pub fn method(&self) -> Result<MethodSetup, Failure> {
        MethodSetup::of(&self.config.label)
    }

    /// What the label of each seed structure depends on in its cost. A program must be there.
    pub fn label_sizes(&self) -> Result<Vec<dft::Size>, Failure> {
        let structures = self.seeds.iter().map(|seed| &seed.seed.structure);
        Ok(match &self.config.label.method {
            LabelMethod::Reference(_) => structures
                .map(|structure| dft::Size { atoms: structure.len(), electrons: 0.0, k_points: 1 })
                .collect(),
            LabelMethod::Code(settings) => {
                let code = settings.prepare(&self.config.label.pass_environment);
                let code = code.map_err(|error| Failure::Input(error.to_string()))?;
                structures.map(|structure| code.size(structure)).collect()
            }
        })
    }

    /// Where the files are that grades depend on, by the keys of the configuration.
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

    /// The hash of a file that the configuration names under this key.
    pub fn hash_of(&self, key: &str) -> String {
        let hashes = self.file_hashes.iter().find(|(name, _)| name == key);
        hashes.map(|(_, hash)| hash.clone()).unwrap_or_default()
    }

    /// Bytes of the largest message between walker and selector: a candidate of the largest seed structure, and the
    /// checkpoints of its walk (three states with velocities and forces, each with what is found again in it).
    pub fn largest_message(&self) -> usize {
        let atoms = self.seeds.iter().map(|named| named.seed.structure.len()).max().unwrap_or(0);
        let features = self.artifact.mixture.dimension();
        8 * atoms * (9 + features) + 512 * atoms + 16_384
    }

    /// The configuration with every default filled in, files by their content instead of their paths: what a campaign
    /// that goes on is compared with.
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
        // What a campaign has that began before there was a choice.
        if self.config.potential.precision == Precision::Double {
            value["potential"].as_object_mut().map(|potential| potential.remove("precision"));
        }
        // Where a campaign is kept is no part of what it is.
        value["run"].as_object_mut().map(|run| run.remove("store"));
        if self.config.campaign.mode == Mode::Reproducible {
            value["instructions"] = json!(instructions());
        }
        let seed = |named: &NamedSeed| {
            format!("{} {}", named.seed.name, ContentHash::from_structure(&named.seed.structure))
        };
        value["seeds"] = self.seeds.iter().map(seed).collect();
        value
    }

    /// The hash of everything that a campaign begins with and that cannot change while it lasts, and of the seed
    /// structures of its start.
    pub fn id(&self) -> CampaignId {
        let fixed = without_changeable(&self.resolved());
        let mut hasher = blake3::Hasher::new();
        hasher.update(b"calmwalk campaign 1");
        hasher.update(fixed.to_string().as_bytes());
        for named in &self.seeds {
            hasher.update(named.seed.name.as_bytes());
            hasher.update(&ContentHash::from_structure(&named.seed.structure).0);
        }
        let mut id = [0; 16];
        id.copy_from_slice(&hasher.finalize().as_bytes()[..16]);
        CampaignId(id)
    }

    /// The seed structures as the store keeps them.
    pub fn stored_seeds(&self) -> Vec<store::SeedStructure> {
        let stored = |(index, named): (usize, &NamedSeed)| store::SeedStructure {
            index: index as u32,
            name: named.seed.name.clone(),
            source: named.source.clone(),
            structure: named.seed.structure.clone(),
        };
        self.seeds.iter().enumerate().map(stored).collect()
    }

    /// What the orchestrator needs of the model.
    pub fn grader(&self) -> Grader {
        grader(&self.model)
    }

    /// What walks need of the configuration.
    pub fn walk_settings(&self) -> WalkSettings {
        let Config { campaign, walk, collect, guard, .. } = &self.config;
        WalkSettings {
            rng_seed: campaign.rng_seed,
            temperature: walk.temperature.get(),
            thermostat: walk.thermostat,
            time_step: walk.time_step.map(|dt| dt.get()),
            equilibration: walk.equilibration,
            steps: walk.steps.get(),
            tau: walk.tau.get(),
            average_steps: walk.average_steps.get(),
            volume_ramp: walk.volume_ramp.map(|ramp| (ramp.from.get(), ramp.to.get())),
            skin: walk.skin.get(),
            collection: collect.when,
            gap: collect.gap,
            declined_gap: collect.declined_gap.get(),
            zbl: guard.zbl.map(|zbl| (zbl.inner.get(), zbl.outer.get())),
            guard: GuardSettings {
                least_distance: guard.least_distance.get(),
                least_distance_fraction: guard.least_distance_fraction.get(),
                highest_temperature: guard.highest_temperature.get(),
                refusals_in_a_row: guard.refusals_in_a_row.get(),
                most_returns: guard.most_returns,
                tau_factor: guard.tau_factor.get(),
                checkpoint_interval: guard.checkpoint_interval.get(),
            },
        }
    }

    /// What the selector needs of the configuration.
    pub fn selector_settings(&self) -> selector::Settings {
        selector_settings(&self.config)
    }
}

/// Both, or what is wrong with either.
fn both<A, B>(
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

/// What grades depend on: the model, its mixture at the start, and the training frames if they are watched. `name` stands
/// for the configuration in what is said about its files.
pub fn load_for_grades(
    config: &Config,
    name: &Path,
) -> Result<(Arc<GraceModel>, Artifact, Option<TrainingFrames>), ConfigError> {
    let loader = Loader { path: name, text: "", config };
    let model = loader.model()?;
    let artifact = loader.artifact(&model)?;
    let training = loader.training_frames(&model, &artifact.mixture)?;
    Ok((model, artifact, training))
}

/// What of a model the grades need.
pub fn grader(model: &GraceModel) -> Grader {
    let n = model.elements().len();
    let cutoffs = (0..n * n).map(|k| model.pair_cutoff(k / n, k % n)).collect();
    Grader::new(model.elements().to_vec(), cutoffs)
}

/// What the selector needs of a configuration.
pub fn selector_settings(config: &Config) -> selector::Settings {
    let Config { campaign, calm, collect, guard, run, .. } = config;
    selector::Settings {
        mode: campaign.mode,
        walks_per_round: run.walks_per_round.get(),
        steps_per_assignment: run.turn_steps.get(),
        update: calm.update,
        search: config.update_settings(),
        forgetting_alarm: ForgettingAlarm { share_above_one: calm.forgetting_alarm },
        collection: collect.when,
        max_per_seed_structure: collect.per_seed.get(),
        max_structures: config.most_structures(),
        control: campaign.control,
        min_distance: (guard.least_distance.get(), guard.least_distance_fraction.get()),
        declined_feature_bytes: collect.declined_features_mb * 1_000_000,
    }
}

/// The instruction sets that the numerical libraries choose among: another choice gives other last bits.
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
