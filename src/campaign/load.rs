//! Reading the files that a configuration names.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use atoms::{NeighbourList, Structure, extxyz, read_structures, shortest_distance};
use calm::{Artifact, ArtifactError, Mixture};
use orchestrator::selector::{SeedStructure, TrainingFrames};
use potentials::grace::{Grace, GraceModel, RadialPath};
use serde_json::Value;
use store::Protocol;
use toml::Spanned;

use super::NamedSeed;
use crate::config::{Config, ConfigError, LabelMethod, PotentialFile, place, place_of_offset};
use crate::labelling::{self, REFERENCE_FILE};

/// Atoms of training frames whose grades are watched, at most: enough for the share above 1 to a percent.
const WATCHED_ATOMS: usize = 4000;

/// What to do about a mixture without scatter matrices and counts.
const NO_UPDATES: &str = "no scatter matrices and counts, so its mixture can be scored with but not updated; give the \
                          gmm_artifacts.npz of the build, or leave calm.artifact out and set update = \"never\" to \
                          take the mixture of the export as it is";

/// Reads files with errors that name the line of the configuration which names the file.
pub(super) struct Loader<'a> {
    /// The configuration's file.
    pub path: &'a Path,
    /// What is in it.
    pub text: &'a str,
    /// What it says.
    pub config: &'a Config,
}

impl Loader<'_> {
    /// The model, which must have a feature map, and cover what the configuration asks of it.
    pub fn model(&self) -> Result<Arc<GraceModel>, ConfigError> {
        let file = &self.config.potential.model;
        let wrong = |message: String| self.wrong("potential.model", file, message);
        let precision = self.config.potential.precision;
        let model = GraceModel::load_in(file.get_ref(), precision, RadialPath::default())
            .map_err(|error| wrong(error.to_string()))?;
        if model.projection().is_none() {
            let shown = file.get_ref().display();
            return Err(wrong(format!(
                "{shown}: no feature projection (uq_* arrays), so nothing can be graded; export the model with its \
                 CALM artifact"
            )));
        }
        if let Some(zbl) = self.config.guard.zbl
            && zbl.outer.get() > model.cutoff()
        {
            let (at, key) = (place(self.path, self.text, "guard.zbl"), "guard.zbl".to_owned());
            let found = format!("outer {} Å", zbl.outer.get());
            let expected = format!("at most the cutoff of the model, {} Å", model.cutoff());
            return Err(ConfigError::Value { at, key, found, expected });
        }
        Ok(Arc::new(model))
    }

    /// The mixture at the start: that of the artifact, or without one that of the export.
    pub fn artifact(&self, model: &GraceModel) -> Result<Artifact, ConfigError> {
        let model_file = &self.config.potential.model;
        let export = Artifact::load_export(model_file.get_ref())
            .map_err(|error| self.wrong("potential.model", model_file, error))?;
        let Some(file) = &self.config.calm.artifact else { return Ok(export) };
        let path = file.get_ref();
        let wrong = |message: String| self.wrong("calm.artifact", file, message);
        let artifact = Artifact::load(path).map_err(|error| wrong(why_no_artifact(path, &error)))?;
        let symbols: Vec<_> = model.elements().iter().map(|species| species.symbol().to_owned()).collect();
        artifact.check_belongs_to(&symbols, &export.projection).map_err(|error| {
            wrong(format!("{}: {error} ({})", path.display(), model_file.get_ref().display()))
        })?;
        Ok(artifact)
    }

    /// Every frame of every file, by a name of its own.
    pub fn seeds(&self, model: &GraceModel) -> Result<Vec<NamedSeed>, ConfigError> {
        let mut seeds: Vec<NamedSeed> = Vec::new();
        for file in &self.config.seeds.files {
            let path = file.get_ref();
            let wrong = |message: String| self.wrong("seeds.files", file, message);
            let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            let frames = read_structures(path).map_err(|error| wrong(error.to_string()))?;
            for (number, frame) in frames.into_iter().enumerate() {
                let source = format!("{}:{}", path.display(), frame.line);
                let named = frame.info.get("name").and_then(extxyz::Value::text).map(str::to_owned);
                let name = named.unwrap_or_else(|| format!("{stem}-{number}"));
                self.check_seed(&frame.structure, model)
                    .map_err(|error| wrong(format!("{source}: {error}")))?;
                if let Some(first) = seeds.iter().find(|other| other.seed.name == name) {
                    return Err(wrong(format!(
                        "{source}: a second seed structure named '{name}', the first is {}; give each a name of its \
                         own (name=… in its comment line)",
                        first.source
                    )));
                }
                seeds.push(NamedSeed { seed: SeedStructure { name, structure: frame.structure }, source });
            }
        }
        Ok(seeds)
    }

    /// A walk must be able to start: elements that the model knows, no atom on top of another, none out of reach of
    /// all others.
    fn check_seed(&self, structure: &Structure, model: &GraceModel) -> Result<(), String> {
        structure.validate().map_err(|error| error.to_string())?;
        model.element_indices(&structure.species).map_err(|error| error.to_string())?;
        let mut neighbours = NeighbourList::new(model.cutoff(), 0.0);
        neighbours.update(structure).map_err(|error| error.to_string())?;
        let least = self.config.guard.least_distance.get();
        if let Some((i, j, d)) = shortest_distance(structure, &neighbours).filter(|(_, _, d)| *d < least) {
            return Err(format!(
                "atoms {i} and {j} are {d:.3} Å apart, closer than guard.least_distance = {least} Å: no walk can start \
                 here"
            ));
        }
        let alone = (0..structure.len()).find(|i| structure.len() > 1 && neighbours.of(*i).is_empty());
        alone.map_or(Ok(()), |atom| {
            let cutoff = model.cutoff();
            Err(format!("atom {atom} has no neighbour within the cutoff, {cutoff} Å: a walk would end at its first step"))
        })
    }

    /// Features of the training frames, evenly thinned to [`WATCHED_ATOMS`].
    pub fn training_frames(
        &self,
        model: &Arc<GraceModel>,
        original: &Mixture,
    ) -> Result<Option<TrainingFrames>, ConfigError> {
        let Some(file) = &self.config.calm.training_frames else { return Ok(None) };
        let wrong = |message: String| self.wrong("calm.training_frames", file, message);
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

    /// How labels are made, and the hashes of files by which they are made.
    pub fn protocol(&self, seeds: &[NamedSeed]) -> Result<(Protocol, Vec<(String, String)>), ConfigError> {
        let (settings, hashes) = match &self.config.label.method {
            LabelMethod::Reference(reference) => self.reference(reference, seeds)?,
            LabelMethod::Code(settings) => (self.code(settings, seeds)?, Vec::new()),
        };
        Ok((labelling::protocol(self.config.label.protocol_name(), settings), hashes))
    }

    fn reference(
        &self,
        reference: &PotentialFile,
        seeds: &[NamedSeed],
    ) -> Result<(Value, Vec<(String, String)>), ConfigError> {
        let wrong = |message: String| self.wrong(REFERENCE_FILE, &reference.file, message);
        let potential = reference.load().map_err(wrong)?;
        for named in seeds {
            if let Some(species) =
                named.seed.structure.species.iter().find(|s| !potential.species().contains(s))
            {
                let (shown, name) = (reference.file.get_ref().display(), &named.seed.name);
                let known: Vec<_> = potential.species().iter().map(|species| species.symbol()).collect();
                let known = known.join(", ");
                return Err(wrong(format!(
                    "{shown}: the label potential knows {known}, but seed structure '{name}' ({}) has {species}",
                    named.source
                )));
            }
        }
        let hash = self.hash(REFERENCE_FILE, &reference.file)?;
        Ok((labelling::reference_identity(reference.kind, &hash.1), vec![hash]))
    }

    /// Settings of a program's protocol; the program must be there, with what it needs for every seed structure.
    fn code(&self, settings: &dft::Settings, seeds: &[NamedSeed]) -> Result<Value, ConfigError> {
        let key = format!("label.method.{}", settings.name());
        let at = || place(self.path, self.text, &key);
        let wrong = |message: String| ConfigError::File { at: at(), key: key.clone(), message };
        let code = settings.prepare().map_err(|error| wrong(error.to_string()))?;
        for named in seeds {
            let species = named.seed.structure.species.iter().copied().collect();
            let supported = code.supports(&species);
            let of_seed = |error| format!("{error} (seed structure '{}', {})", named.seed.name, named.source);
            supported.map_err(|error| wrong(of_seed(error)))?;
        }
        Ok(labelling::identity(settings.name(), &*code))
    }

    /// A key and the hash of the file that it names.
    pub fn hash(&self, key: &str, file: &Spanned<PathBuf>) -> Result<(String, String), ConfigError> {
        let bytes = std::fs::read(file.get_ref()).map_err(|error| {
            self.wrong(key, file, format!("cannot read {}: {error}", file.get_ref().display()))
        })?;
        Ok((key.to_owned(), blake3::hash(&bytes).to_string()))
    }

    fn wrong(&self, key: &str, file: &Spanned<PathBuf>, message: impl ToString) -> ConfigError {
        let at = place_of_offset(self.path, self.text, file.span().start);
        ConfigError::File { at, key: key.to_owned(), message: message.to_string() }
    }
}

/// What is wrong with an artifact; an export, and an artifact stripped of its statistics, are mistaken for one easily.
fn why_no_artifact(path: &Path, error: &ArtifactError) -> String {
    let stripped = matches!(error, ArtifactError::Missing { key, .. } if key.starts_with("scatter_") || key.starts_with("counts_"));
    if stripped || Artifact::load_export(path).is_ok() {
        format!("{}: {NO_UPDATES}", path.display())
    } else {
        error.to_string()
    }
}
