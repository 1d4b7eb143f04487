//! Everything that a configuration names, loaded and checked: what `validate` does and `run` begins with.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use atoms::{NeighbourList, Potential, Structure, extxyz, read_structures, shortest_distance};
use calm::watch::ForgettingAlarm;
use calm::{Artifact, Mixture};
use orchestrator::grader::Grader;
use orchestrator::selector::{self, SeedStructure, TrainingFrames};
use potentials::grace::{Grace, GraceModel};
use serde_json::{Value, json};
use store::Protocol;
use toml::Spanned;
use wire::{CampaignId, ContentHash};
use workers::settings::{GuardSettings, WalkSettings};

use crate::config::{Config, ConfigError, LabelMethod, place_of_offset, without_changeable};

/// Keys that name files: a campaign depends on what is in them, not on where they are.
const FILE_KEYS: [&str; 4] =
    ["/potential/model", "/calm/artifact", "/calm/training_frames", "/label/method/reference/file"];

/// Atoms of training frames whose grades are watched, at most: enough for the share above 1 to a percent.
const WATCHED_ATOMS: usize = 4000;

/// A campaign ready to run.
pub struct Campaign {
    /// The configuration.
    pub config: Config,
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
}

/// A seed structure and where it came from.
pub struct NamedSeed {
    /// Name and structure.
    pub seed: SeedStructure,
    /// `file:line`
    pub source: String,
}

/// Loads with errors that name the line of the configuration which names the file.
struct Loader<'a> {
    path: &'a Path,
    text: &'a str,
}

impl Loader<'_> {
    fn wrong(&self, key: &str, file: &Spanned<PathBuf>, message: impl ToString) -> ConfigError {
        let at = place_of_offset(self.path, self.text, file.span().start);
        ConfigError::File { at, key: key.to_owned(), message: message.to_string() }
    }

    fn hash(&self, key: &str, file: &Spanned<PathBuf>) -> Result<(String, String), ConfigError> {
        let bytes = std::fs::read(file.get_ref())
            .map_err(|error| self.wrong(key, file, format!("cannot read {}: {error}", file.get_ref().display())))?;
        Ok((key.to_owned(), blake3::hash(&bytes).to_string()))
    }
}

impl Campaign {
    /// Reads a configuration and every file that it names.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let config = Config::load(path)?;
        let text = std::fs::read_to_string(path)
            .map_err(|source| ConfigError::Read { path: path.to_owned(), source })?;
        let loader = Loader { path, text: &text };
        let model = load_model(&loader, &config)?;
        let artifact = load_artifact(&loader, &config, &model)?;
        let seeds = load_seeds(&loader, &config, &model)?;
        let training = load_training(&loader, &config, &model, &artifact.mixture)?;
        let (protocol, label_hash) = load_protocol(&loader, &config, &seeds)?;
        let mut file_hashes = vec![
            loader.hash("potential.model", &config.potential.model)?,
            loader.hash("calm.artifact", &config.calm.artifact)?,
            label_hash,
        ];
        if let Some(file) = &config.calm.training_frames {
            file_hashes.push(loader.hash("calm.training_frames", file)?);
        }
        Ok(Self { config, text, model, artifact, seeds, training, protocol, file_hashes })
    }

    /// The label source, one for each labeller.
    pub fn reference_potential(&self) -> Result<Box<dyn Potential>, String> {
        let LabelMethod::Reference(potential) = &self.config.label.method;
        potential.load()
    }

    /// The configuration with every default filled in, files by their content instead of their paths: what a campaign
    /// that goes on is compared with.
    pub fn resolved(&self) -> Value {
        let mut value = serde_json::to_value(&self.config).expect("plain data becomes JSON");
        for pointer in FILE_KEYS {
            if let Some(path) = value.pointer_mut(pointer) {
                *path = Value::Null;
            }
        }
        let hashes = self.file_hashes.iter().map(|(key, hash)| (key.clone(), json!(hash)));
        value["files"] = Value::Object(hashes.collect());
        let seed = |named: &NamedSeed| format!("{} {}", named.seed.name, ContentHash::of(&named.seed.structure));
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
            hasher.update(&ContentHash::of(&named.seed.structure).0);
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
        let n = self.model.elements().len();
        let cutoffs = (0..n * n).map(|k| self.model.pair_cutoff(k / n, k % n)).collect();
        Grader::new(self.model.elements().to_vec(), cutoffs)
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
        let Config { campaign, calm, collect, guard, run, .. } = &self.config;
        selector::Settings {
            mode: campaign.mode,
            walks_per_round: run.walks_per_round.get(),
            turn_steps: run.turn_steps.get(),
            update: calm.update,
            search: self.config.update_settings(),
            forgetting_alarm: ForgettingAlarm { share_above_one: calm.forgetting_alarm },
            collection: collect.when,
            per_seed: collect.per_seed.get(),
            total: collect.total.map(|total| total.get()),
            control: campaign.control,
            least_distance: (guard.least_distance.get(), guard.least_distance_fraction.get()),
            declined_feature_bytes: collect.declined_features_mb * 1_000_000,
        }
    }
}

fn load_model(loader: &Loader<'_>, config: &Config) -> Result<Arc<GraceModel>, ConfigError> {
    let file = &config.potential.model;
    let wrong = |message: String| loader.wrong("potential.model", file, message);
    let model = GraceModel::load(file.get_ref()).map_err(|error| wrong(error.to_string()))?;
    if model.projection().is_none() {
        return Err(wrong("the model has no feature projection (uq_* arrays): export it with its CALM artifact".into()));
    }
    Ok(Arc::new(model))
}

fn load_artifact(loader: &Loader<'_>, config: &Config, model: &GraceModel) -> Result<Artifact, ConfigError> {
    let file = &config.calm.artifact;
    let wrong = |message: String| loader.wrong("calm.artifact", file, message);
    let artifact = Artifact::load(file.get_ref()).map_err(|error| wrong(error.to_string()))?;
    let export = Artifact::load_export(config.potential.model.get_ref())
        .map_err(|error| loader.wrong("potential.model", &config.potential.model, error))?;
    let symbols: Vec<_> = model.elements().iter().map(|species| species.symbol().to_owned()).collect();
    artifact.check_belongs_to(&symbols, &export.projection).map_err(|error| wrong(error.to_string()))?;
    let updates = config.calm.update != orchestrator::selector::UpdateProtocol::Never;
    if updates && !artifact.mixture.can_be_updated() {
        return Err(wrong(
            "the artifact has no scatter matrices and counts, so the mixture can be scored with but not updated; \
             give the gmm_artifacts.npz of the build, or set update = \"never\""
                .into(),
        ));
    }
    Ok(artifact)
}

fn load_seeds(loader: &Loader<'_>, config: &Config, model: &GraceModel) -> Result<Vec<NamedSeed>, ConfigError> {
    let mut seeds: Vec<NamedSeed> = Vec::new();
    for file in &config.seeds.files {
        let path = file.get_ref();
        let wrong = |message: String| loader.wrong("seeds.files", file, message);
        let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let frames = read_structures(path).map_err(|error| wrong(error.to_string()))?;
        for (number, frame) in frames.into_iter().enumerate() {
            let source = format!("{}:{}", path.display(), frame.line);
            let named = frame.info.get("name").and_then(extxyz::Value::text).map(str::to_owned);
            let name = named.unwrap_or_else(|| format!("{stem}-{number}"));
            check_seed(&frame.structure, config, model).map_err(|error| wrong(format!("{source}: {error}")))?;
            if seeds.iter().any(|other| other.seed.name == name) {
                return Err(wrong(format!("{source}: a second seed structure is named '{name}'")));
            }
            seeds.push(NamedSeed { seed: SeedStructure { name, structure: frame.structure }, source });
        }
    }
    Ok(seeds)
}

/// A seed structure must be one that the model knows and whose atoms are not on top of each other.
fn check_seed(structure: &Structure, config: &Config, model: &GraceModel) -> Result<(), String> {
    structure.validate().map_err(|error| error.to_string())?;
    model.element_indices(&structure.species).map_err(|error| error.to_string())?;
    let mut neighbours = NeighbourList::new(model.cutoff(), 0.0);
    neighbours.update(structure).map_err(|error| error.to_string())?;
    let least = config.guard.least_distance.get();
    match shortest_distance(structure, &neighbours) {
        Some((i, j, d)) if d < least => Err(format!(
            "atoms {i} and {j} are {d:.3} Å apart, closer than guard.least_distance = {least} Å: no walk can start here"
        )),
        _ => Ok(()),
    }
}

/// Features of the training frames, evenly thinned to [`WATCHED_ATOMS`].
fn load_training(
    loader: &Loader<'_>,
    config: &Config,
    model: &Arc<GraceModel>,
    original: &Mixture,
) -> Result<Option<TrainingFrames>, ConfigError> {
    let Some(file) = &config.calm.training_frames else { return Ok(None) };
    let wrong = |message: String| loader.wrong("calm.training_frames", file, message);
    let frames = read_structures(file.get_ref()).map_err(|error| wrong(error.to_string()))?;
    let atoms: usize = frames.iter().map(|frame| frame.structure.len()).sum();
    let every = atoms.div_ceil(WATCHED_ATOMS);
    let mut grace = Grace::new(Arc::clone(model));
    let mut neighbours = NeighbourList::new(model.cutoff(), 0.0);
    let (mut elements, mut features) = (Vec::new(), Vec::new());
    for frame in frames.iter().step_by(every) {
        let mut evaluate = || -> Result<Vec<usize>, String> {
            neighbours.update(&frame.structure).map_err(|error| error.to_string())?;
            grace.forward(&frame.structure, &neighbours).map_err(|error| error.to_string())?;
            model.element_indices(&frame.structure.species).map_err(|error| error.to_string())
        };
        let of_frame = evaluate();
        let place = || format!("{}:{}", file.get_ref().display(), frame.line);
        elements.extend(of_frame.map_err(|error| wrong(format!("{}: {error}", place())))?);
        features.extend_from_slice(grace.features());
    }
    TrainingFrames::new(elements, features, original).map(Some).map_err(|error| wrong(error.to_string()))
}

fn load_protocol(
    loader: &Loader<'_>,
    config: &Config,
    seeds: &[NamedSeed],
) -> Result<(Protocol, (String, String)), ConfigError> {
    let LabelMethod::Reference(reference) = &config.label.method;
    let wrong = |message: String| loader.wrong("label.method.reference.file", &reference.file, message);
    let potential = reference.load().map_err(wrong)?;
    for named in seeds {
        if let Some(species) = named.seed.structure.species.iter().find(|s| !potential.species().contains(s)) {
            let name = &named.seed.name;
            return Err(wrong(format!("the label potential does not know {species} of seed structure '{name}'")));
        }
    }
    let file_hash = loader.hash("label.method.reference.file", &reference.file)?;
    let settings = serde_json::json!({ "method": "reference", "kind": reference.kind, "file_hash": file_hash.1 });
    let hash = ContentHash(*blake3::hash(settings.to_string().as_bytes()).as_bytes());
    Ok((Protocol { hash, name: config.label.protocol.clone(), settings }, file_hash))
}
