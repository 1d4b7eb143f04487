//! Reads the files that a configuration names.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use atoms::{NeighbourList, Structure};
use bridge::PythonModel;
use calm::forgetting::GradeDistribution;
use calm::{Artifact, ArtifactError, Grades, Mixture, Projection};
use dft::SetupError;
use orchestrator::selector::{CampaignMode, TrainingFrames, UpdateProtocol};
use potentials::grace::{GraceModel, RadialPath, Threads};
use potentials::{ModelWithFeatures, PotentialWithFeatures};
use serde_json::Value;
use store::Protocol;
use tokio_util::sync::CancellationToken;
use toml::Spanned;

use super::loader::Loader;
use super::seed_structures::{SeedStructures, SourcedStructure};
use super::training_sample::{self, SampledFrame};
use crate::all_cores;
use crate::artifact_checks::{check_belongs_to, check_sound};
use crate::config::{ConfigError, LabelMethod, OnInvalid, PotentialConfig, Warning, location};
use crate::file_hash;
use crate::label_method::{self, REFERENCE_FILE};
use crate::loaded_model::LoadedModel;
use crate::python_model::{self, NOT_DETERMINISTIC};

/// Largest number of seed-structure atoms that are graded.
const MAX_GRADED_ATOMS: usize = 256;

/// A mixture with γ below this everywhere cannot distinguish new structures.
const MIN_MEDIAN_GRADE: f64 = 1e-3;

/// Above the usual share: fresh mixtures have 2 to 9 % of their training atoms above 1.
const SUSPICIOUS_SHARE: f64 = 0.25;

const TRAINING_FRAMES: &str = "calm.training_frames";

/// What to do about a mixture without scatter matrices and counts.
const NO_STATISTICS: &str = "no scatter matrices and counts, so its mixture can grade structures but cannot be updated; give the \
                          gmm_artifacts.npz of the build, or leave calm.artifact out and set update = \"never\" to \
                          take the mixture of the export as it is";

impl Loader<'_> {
    /// Loads the model, or starts its program. It must support the configured settings. Without a projection of its features, it gets
    /// that of the artifact.
    pub fn model(&self) -> Result<LoadedModel, ConfigError> {
        let potential = &self.config.potential;
        let file = &potential.model;
        let wrong = |message: String| self.file_error("potential.model", file, message);
        let model: LoadedModel = match &potential.python {
            None => GraceModel::load_in(file.get_ref(), potential.precision, RadialPath::default())
                .map_err(|error| wrong(error.to_string()))?
                .into(),
            Some(_) => {
                let settings = self.config.python_settings();
                let key = "potential.python".to_owned();
                let at = location(self.path, self.text, &key);
                let failed = |message| ConfigError::File { at, key, message };
                let same_bits = self.config.campaign.mode == CampaignMode::Reproducible;
                let devices = python_model::start(settings, same_bits, &CancellationToken::new());
                let devices = devices.map_err(|error| error.to_string());
                let model = devices.and_then(PythonModel::local).map_err(failed)?;
                self.check_python(&model)?;
                LoadedModel::Python(Arc::new(model))
            }
        };
        let model = if model.dimension() > 0 { model } else { self.projected(model)? };
        let widest = self.config.guard.zbl.as_ref().and_then(|windows| windows.widest(model.elements()));
        if let Some((pair, window)) = widest
            && window.outer > model.cutoff()
        {
            let (at, key) = (location(self.path, self.text, "guard.zbl"), "guard.zbl".to_owned());
            let found = format!("outer {} Å of {pair}", window.outer);
            let expected = format!("at most the cutoff of the model, {} Å", model.cutoff());
            return Err(ConfigError::Value { at, key, found, expected });
        }
        Ok(model)
    }

    /// Reproducible campaigns need results that depend on the structure only.
    fn check_python(&self, model: &PythonModel) -> Result<(), ConfigError> {
        if self.config.refit.is_some() {
            let key = "refit".to_owned();
            let expected = "left out with potential.python: refits train exported GRACE models".to_owned();
            return Err(ConfigError::Value {
                at: location(self.path, self.text, &key),
                key,
                found: "a section".to_owned(),
                expected,
            });
        }
        let max_batch = self.config.potential.python.as_ref().map_or(1, |python| python.max_batch.get());
        let Some(reason) = python_model::irreproducible(model.devices(), max_batch) else { return Ok(()) };
        if self.config.campaign.mode == CampaignMode::Live {
            return Ok(());
        }
        let key = "campaign.mode".to_owned();
        let or = if reason == NOT_DETERMINISTIC { "" } else { ", or potential.python.max_batch = 1" };
        let (found, expected) = ("\"reproducible\"".to_owned(), format!("\"live\"{or}: {reason}"));
        Err(ConfigError::Value { at: location(self.path, self.text, &key), key, found, expected })
    }

    /// Key and hash of the model.
    pub fn model_hash(&self, model: &LoadedModel) -> Result<(String, String), ConfigError> {
        let key = "potential.model";
        match model {
            LoadedModel::Grace(_) => self.hash(key, &self.config.potential.model),
            LoadedModel::Python(model) => Ok((key.to_owned(), model.description().identity.clone())),
        }
    }

    /// The model with the projection of the artifact.
    fn projected(&self, model: LoadedModel) -> Result<LoadedModel, ConfigError> {
        let Some(file) = &self.config.calm.artifact else {
            let file = &self.config.potential.model;
            let message = format!(
                "{}: no feature projection (uq_* arrays), so nothing can be graded; set calm.artifact, which has one, or \
                 build a mixture (calmwalk calm build)",
                file.get_ref().display()
            );
            return Err(self.file_error("potential.model", file, message));
        };
        let path = file.get_ref();
        let wrong = |message: String| self.file_error("calm.artifact", file, message);
        let projection =
            Projection::load(path).map_err(|error| wrong(explain_artifact_error(path, &error)))?;
        model.with_projection(&projection).map_err(|error| wrong(format!("{}: {error}", path.display())))
    }

    /// Checks that an update ends what made a seed structure's atoms a candidate. Otherwise its walks would offer the
    /// same structure again and again.
    pub fn check_update_target(&self, seeds: &[SourcedStructure]) -> Result<(), ConfigError> {
        let (rule, criterion) = (&self.config.collect.update_target, &self.config.collect.criterion);
        let mut sizes = seeds.iter().map(|named| named.plan.structure.len());
        let Some(atoms) = sizes.find(|atoms| !rule.ends_candidacy(criterion, *atoms)) else { return Ok(()) };
        if self.config.calm.update == UpdateProtocol::Never {
            return Ok(());
        }
        let key = "collect.update_target".to_owned();
        let expected = format!(
            "a rule after which a structure of {atoms} atoms is no longer a candidate ({}): otherwise walks collect the \
             same structure again and again",
            criterion.condition(atoms)
        );
        Err(ConfigError::Value {
            at: location(self.path, self.text, &key),
            key,
            found: rule.condition(atoms),
            expected,
        })
    }

    /// Loads the initial mixture: that of the artifact, or else that of the export.
    pub fn artifact(&self, model: &LoadedModel) -> Result<Artifact, ConfigError> {
        let model_file = &self.config.potential.model;
        let Some(file) = &self.config.calm.artifact else {
            let export = Artifact::load_export(model_file.get_ref())
                .map_err(|error| self.file_error("potential.model", model_file, error))?;
            check_sound(&export, model_file.get_ref())
                .map_err(|message| self.file_error("potential.model", model_file, message))?;
            return Ok(export);
        };
        let path = file.get_ref();
        let wrong = |message: String| self.file_error("calm.artifact", file, message);
        let artifact = Artifact::load(path).map_err(|error| wrong(explain_artifact_error(path, &error)))?;
        check_belongs_to(&artifact, model).map_err(|error| {
            wrong(format!("{}: {error} ({})", path.display(), model_file.get_ref().display()))
        })?;
        check_sound(&artifact, path).map_err(wrong)?;
        Ok(artifact)
    }

    /// Computes features of a sample of the training frames. The median of γ must be between 0.001 and 1.
    pub fn training_frames(
        &self,
        model: &LoadedModel,
        original: &Mixture,
    ) -> Result<Option<TrainingFrames>, ConfigError> {
        let Some(file) = &self.config.calm.training_frames else { return Ok(None) };
        let wrong = |message: String| self.file_error(TRAINING_FRAMES, file, message);
        let path = file.get_ref();
        let sample = training_sample::read(path).map_err(wrong)?;
        let model = model.shared();
        let features = all_cores::map(sample.iter(), || Features::new(&model), Features::of_sample);
        let (mut elements, mut values) = (Vec::new(), Vec::new());
        for (frame, features) in sample.iter().zip(features) {
            let in_frame = |error: String| wrong(format!("{}:{}: {error}", path.display(), frame.line));
            let (frame_elements, frame_values) = features.map_err(in_frame)?;
            elements.extend(frame_elements);
            values.extend(frame_values);
        }
        let training =
            TrainingFrames::new(&elements, &values, original).map_err(|error| wrong(error.to_string()))?;
        let median = training.original().median;
        if !(MIN_MEDIAN_GRADE..=1.0).contains(&median) {
            return Err(wrong(format!(
                "{}: the median of γ is {median:.3e} under the initial mixture; expected {MIN_MEDIAN_GRADE} to 1: either \
                 these are not the frames that the mixture was built from, or its covariances or thresholds are wrong",
                path.display()
            )));
        }
        Ok(Some(training))
    }

    /// Warns of suspicious initial grades.
    pub fn suspicious_grades(
        &self,
        model: &LoadedModel,
        artifact: &Artifact,
        seeds: &[SourcedStructure],
        training: Option<&TrainingFrames>,
    ) -> Result<Option<Warning>, ConfigError> {
        if let (Some(training), Some(file)) = (training, &self.config.calm.training_frames) {
            let share = training.original().share_above_one;
            return Ok((share > SUSPICIOUS_SHARE).then(|| {
                let percent = 100.0 * share;
                let message = format!(
                    "{percent:.0} % of the atoms have γ > 1 under the initial mixture, where 2 to 9 % are usual: \
                     are these the frames that the mixture was built from?"
                );
                self.warning(TRAINING_FRAMES, file, message)
            }));
        }
        let file = self.config.calm.artifact.as_ref().unwrap_or(&self.config.potential.model);
        let key = if self.config.calm.artifact.is_some() { "calm.artifact" } else { "potential.model" };
        let wrong = |message: String| self.file_error(key, file, message);
        let (mut features, mut grades) = (Features::new(&model.shared()), Grades::default());
        let (mut gamma, mut first_error) = (Vec::new(), None);
        for SourcedStructure { plan, source, .. } in seeds {
            let graded = features.compute(&plan.structure).and_then(|elements| {
                let values = features.potential.features();
                let graded = grades.evaluate(&artifact.mixture, &elements, values, None);
                graded.map_err(|error| error.to_string())
            });
            match graded {
                Ok(()) => gamma.extend_from_slice(&grades.gamma),
                // Triage lists those that cannot be graded.
                Err(error) => {
                    let of_seed_structure =
                        || wrong(format!("seed structure '{}' ({source}): {error}", plan.name));
                    first_error.get_or_insert_with(of_seed_structure);
                }
            }
            if gamma.len() >= MAX_GRADED_ATOMS {
                break;
            }
        }
        if let Some(error) = first_error.filter(|_| gamma.is_empty()) {
            return Err(error);
        }
        let grades = GradeDistribution::from_grades(&gamma);
        Ok((grades.median < MIN_MEDIAN_GRADE).then(|| {
            let message = format!(
                "the median of γ over the seed structures is {:.1e}, where 0.1 to 2 is usual: with such a mixture nothing \
                 is ever collected",
                grades.median
            );
            self.warning(key, file, message)
        }))
    }

    /// The label protocol and the hashes of its files. Seed structures that cannot be labelled are left out if the
    /// configuration allows it and others remain.
    pub fn protocol(
        &self,
        seeds: &mut SeedStructures,
    ) -> Result<(Protocol, Vec<(String, String)>), ConfigError> {
        let (settings, hashes) = match &self.config.label.method {
            LabelMethod::Potential(reference) => self.reference(reference, seeds)?,
            LabelMethod::Code(settings) => (self.code(settings, seeds)?, Vec::new()),
        };
        Ok((label_method::protocol(self.config.label.protocol_name(), settings), hashes))
    }

    fn reference(
        &self,
        reference: &PotentialConfig,
        seeds: &mut SeedStructures,
    ) -> Result<(Value, Vec<(String, String)>), ConfigError> {
        let file = reference.file.get_ref();
        let wrong = |message: String| self.file_error(REFERENCE_FILE, &reference.file, message);
        let potential = reference.load().map_err(wrong)?;
        let known: Vec<_> = potential.species().iter().map(|species| species.symbol()).collect();
        let knows = format!("the label potential knows {}", known.join(", "));
        let unknown = |structure: &Structure| {
            let species = structure.species.iter().find(|species| !potential.species().contains(species));
            species.map(|species| format!("{knows}, but the structure has {species}"))
        };
        let reasons = seeds.valid.iter().map(|named| unknown(&named.plan.structure)).collect();
        self.skip_unlabelled(seeds, reasons)
            .map_err(|message| wrong(format!("{}: {message}", file.display())))?;
        let hash = self.hash(REFERENCE_FILE, &reference.file)?;
        Ok((label_method::potential_identity(reference.kind, &hash.1), vec![hash]))
    }

    /// Protocol settings of a program, which must be installed.
    fn code(&self, settings: &dft::DftSettings, seeds: &mut SeedStructures) -> Result<Value, ConfigError> {
        let key = format!("label.method.{}", settings.name());
        let at = || location(self.path, self.text, &key);
        let wrong = |message: String| ConfigError::File { at: at(), key: key.clone(), message };
        let code = settings.prepare(&self.config.label.pass_environment);
        let code = code.map_err(|error| wrong(error.to_string()))?;
        // A setting is wrong for any structure, files may be missing for an element.
        let unsupported = |named: &SourcedStructure| {
            let species = named.plan.structure.species.iter().copied().collect();
            match code.supports(&species) {
                Ok(()) => Ok(None),
                Err(error @ SetupError::Pseudopotential { .. }) => Ok(Some(error.to_string())),
                Err(error) => Err(wrong(with_seed_structure(&error.to_string(), named))),
            }
        };
        let reasons = seeds.valid.iter().map(unsupported).collect::<Result<_, _>>()?;
        self.skip_unlabelled(seeds, reasons).map_err(wrong)?;
        Ok(label_method::code_identity(settings.name(), &*code))
    }

    /// Leaves out the seed structures for which there is a reason. Fails with the first reason if the configuration
    /// requires all of them, or if none remains.
    fn skip_unlabelled(
        &self,
        seeds: &mut SeedStructures,
        reasons: Vec<Option<String>>,
    ) -> Result<(), String> {
        let is_refused =
            self.config.seed_structures.on_invalid == OnInvalid::Error || reasons.iter().all(Option::is_some);
        let first =
            seeds.valid.iter().zip(&reasons).find_map(|(named, reason)| Some((named, reason.as_ref()?)));
        if let Some((named, reason)) = first.filter(|_| is_refused) {
            return Err(with_seed_structure(reason, named));
        }
        let mut reasons = reasons.into_iter();
        seeds.skip(|_| reasons.next().flatten());
        Ok(())
    }

    /// A key and the hash of the file that it names.
    pub fn hash(&self, key: &str, file: &Spanned<PathBuf>) -> Result<(String, String), ConfigError> {
        let hash = file_hash::hash(file.get_ref()).map_err(|error| {
            self.file_error(key, file, format!("cannot read {}: {error}", file.get_ref().display()))
        })?;
        Ok((key.to_owned(), hash))
    }
}

/// A message about a seed structure.
fn with_seed_structure(message: &str, SourcedStructure { plan, source, .. }: &SourcedStructure) -> String {
    format!("{message} (seed structure '{}', {source})", plan.name)
}

/// Computes features of structures one after another.
struct Features {
    potential: Box<dyn PotentialWithFeatures>,
    neighbours: NeighbourList,
}

impl Features {
    fn new(model: &Arc<dyn ModelWithFeatures>) -> Self {
        let neighbours = NeighbourList::new(model.cutoff(), 0.0);
        Self { potential: Arc::clone(model).evaluator(Threads::default()), neighbours }
    }

    /// Computes the features of all atoms. Returns their element indices.
    fn compute(&mut self, structure: &Structure) -> Result<Vec<usize>, String> {
        let elements = self.potential.model().element_indices(&structure.species);
        let elements = elements.map_err(|error| error.to_string())?;
        self.neighbours.update(structure).map_err(|error| error.to_string())?;
        self.potential.forward(structure, &self.neighbours).map_err(|error| error.to_string())?;
        Ok(elements)
    }

    /// Element indices and features, [n × D], of the atoms of a frame that belong to the sample.
    fn of_sample(&mut self, frame: &SampledFrame) -> Result<(Vec<usize>, Vec<f64>), String> {
        let elements = self.compute(&frame.structure)?;
        let features = self.potential.features();
        let dimension = features.len() / elements.len().max(1);
        let rows = frame.atoms.iter().flat_map(|atom| &features[atom * dimension..][..dimension]);
        Ok((frame.atoms.iter().map(|atom| elements[*atom]).collect(), rows.copied().collect()))
    }
}

/// Explains why an artifact is invalid. Users easily confuse it with an export or an artifact without statistics.
fn explain_artifact_error(path: &Path, error: &ArtifactError) -> String {
    let stripped = matches!(error, ArtifactError::Missing { key, .. } if key.starts_with("scatter_") || key.starts_with("counts_"));
    if stripped || Artifact::load_export(path).is_ok() {
        format!("{}: {NO_STATISTICS}", path.display())
    } else {
        error.to_string()
    }
}
