//! Reading the files that a configuration names.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use atoms::{NeighbourList, Structure, read_structures};
use calm::forgetting::grade_distribution;
use calm::{Artifact, ArtifactError, Mixture};
use orchestrator::selector::TrainingFrames;
use potentials::grace::{Grace, GraceModel, RadialPath};
use serde_json::Value;
use store::Protocol;
use toml::Spanned;

use super::NamedSeed;
use crate::config::{Config, ConfigError, LabelMethod, PotentialFile, Warning, place, place_of_offset};
use crate::labelling::{self, REFERENCE_FILE};

/// Atoms of training frames whose grades are watched, at most: enough for the share above 1 to a percent.
const WATCHED_ATOMS: usize = 4000;

/// Atoms of seed structures whose grades are looked at.
const GRADED_ATOMS: usize = 256;

/// A mixture under which γ is less than this everywhere knows everything, and so nothing.
const NO_GRADE: f64 = 1e-3;

/// Fresh mixtures leave 2 to 9 % of their training atoms above 1.
const DOUBTFUL_SHARE: f64 = 0.25;

const TRAINING_FRAMES: &str = "calm.training_frames";

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
        let Some(file) = &self.config.calm.artifact else {
            check_sound(&export, model_file.get_ref())
                .map_err(|message| self.wrong("potential.model", model_file, message))?;
            return Ok(export);
        };
        let path = file.get_ref();
        let wrong = |message: String| self.wrong("calm.artifact", file, message);
        let artifact = Artifact::load(path).map_err(|error| wrong(why_no_artifact(path, &error)))?;
        let symbols: Vec<_> = model.elements().iter().map(|species| species.symbol().to_owned()).collect();
        artifact.check_belongs_to(&symbols, &export.projection).map_err(|error| {
            wrong(format!("{}: {error} ({})", path.display(), model_file.get_ref().display()))
        })?;
        check_sound(&artifact, path).map_err(wrong)?;
        Ok(artifact)
    }

    /// Features of the training frames, evenly thinned to [`WATCHED_ATOMS`]. Most of them must have 0.001 < γ < 1.
    pub fn training_frames(
        &self,
        model: &Arc<GraceModel>,
        original: &Mixture,
    ) -> Result<Option<TrainingFrames>, ConfigError> {
        let Some(file) = &self.config.calm.training_frames else { return Ok(None) };
        let wrong = |message: String| self.wrong(TRAINING_FRAMES, file, message);
        let frames = read_structures(file.get_ref()).map_err(|error| wrong(error.to_string()))?;
        let atoms: usize = frames.iter().map(|frame| frame.structure.len()).sum();
        let every = atoms.div_ceil(WATCHED_ATOMS);
        let mut features = Features::of(model);
        for frame in frames.iter().step_by(every) {
            let place = || format!("{}:{}", file.get_ref().display(), frame.line);
            features.add(&frame.structure).map_err(|error| wrong(format!("{}: {error}", place())))?;
        }
        let training = TrainingFrames::new(features.elements, features.values, original)
            .map_err(|error| wrong(error.to_string()))?;
        let median = training.original.median;
        if !(NO_GRADE..=1.0).contains(&median) {
            return Err(wrong(format!(
                "{}: the median of γ is {median:.3e} under the mixture as it begins; expected {NO_GRADE} to 1: either \
                 these are not the frames that the mixture was built from, or its covariances or thresholds are wrong",
                file.get_ref().display()
            )));
        }
        Ok(Some(training))
    }

    /// What is doubtful about the grades at the start.
    pub fn doubtful_grades(
        &self,
        model: &Arc<GraceModel>,
        artifact: &Artifact,
        seeds: &[NamedSeed],
        training: Option<&TrainingFrames>,
    ) -> Result<Option<Warning>, ConfigError> {
        if let (Some(training), Some(file)) = (training, &self.config.calm.training_frames) {
            let share = training.original.share_above_one;
            return Ok((share > DOUBTFUL_SHARE).then(|| {
                let percent = 100.0 * share;
                let message = format!(
                    "{percent:.0} % of the atoms have γ > 1 under the mixture as it begins, where 2 to 9 % are usual: \
                     are these the frames that the mixture was built from?"
                );
                self.warning(TRAINING_FRAMES, file, message)
            }));
        }
        let file = self.config.calm.artifact.as_ref().unwrap_or(&self.config.potential.model);
        let key = if self.config.calm.artifact.is_some() { "calm.artifact" } else { "potential.model" };
        let wrong = |message: String| self.wrong(key, file, message);
        let mut features = Features::of(model);
        for named in seeds {
            let of_seed =
                |error| wrong(format!("seed structure '{}' ({}): {error}", named.seed.name, named.source));
            features.add(&named.seed.structure).map_err(of_seed)?;
            if features.elements.len() >= GRADED_ATOMS {
                break;
            }
        }
        let grades = grade_distribution(&artifact.mixture, &features.elements, &features.values)
            .map_err(|error| wrong(error.to_string()))?;
        Ok((grades.median < NO_GRADE).then(|| {
            let message = format!(
                "the median of γ over the seed structures is {:.1e}, where 0.1 to 2 is usual: with such a mixture nothing \
                 is ever collected",
                grades.median
            );
            self.warning(key, file, message)
        }))
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
        let code = settings.prepare(&self.config.label.pass_environment);
        let code = code.map_err(|error| wrong(error.to_string()))?;
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

    pub(super) fn wrong(&self, key: &str, file: &Spanned<PathBuf>, message: impl ToString) -> ConfigError {
        let at = place_of_offset(self.path, self.text, file.span().start);
        ConfigError::File { at, key: key.to_owned(), message: message.to_string() }
    }

    pub(super) fn warning(&self, key: &str, file: &Spanned<PathBuf>, message: String) -> Warning {
        Warning { at: place_of_offset(self.path, self.text, file.span().start), key: key.to_owned(), message }
    }
}

/// Features of one structure after another.
struct Features {
    grace: Grace,
    neighbours: NeighbourList,
    /// Element index of each atom.
    elements: Vec<usize>,
    /// [atoms × D]
    values: Vec<f64>,
}

impl Features {
    fn of(model: &Arc<GraceModel>) -> Self {
        let (grace, neighbours) = (Grace::new(Arc::clone(model)), NeighbourList::new(model.cutoff(), 0.0));
        Self { grace, neighbours, elements: Vec::new(), values: Vec::new() }
    }

    fn add(&mut self, structure: &Structure) -> Result<(), String> {
        self.neighbours.update(structure).map_err(|error| error.to_string())?;
        self.grace.forward(structure, &self.neighbours).map_err(|error| error.to_string())?;
        let elements = self.grace.model().element_indices(&structure.species);
        self.elements.extend(elements.map_err(|error| error.to_string())?);
        self.values.extend_from_slice(self.grace.features());
        Ok(())
    }
}

/// Refuses an artifact whose numbers no training data can have made.
pub fn check_sound(artifact: &Artifact, path: &Path) -> Result<(), String> {
    let faults = artifact.unsound_components();
    let Some(first) = faults.first() else { return Ok(()) };
    let more = match faults.len() - 1 {
        0 => String::new(),
        more => format!(" (and {more} more: calmwalk calm info {})", path.display()),
    };
    Err(format!(
        "{}: {first}{more}; build the artifact again, or copy it again from where it was built",
        path.display()
    ))
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
